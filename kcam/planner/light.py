"""The light of a scene, as estimates ask for it: what a camera records of it, in few spectra, and how it is spread."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from kcam.camera import Camera
from kcam.isp import Clip
from kcam.optics import Imaging
from kcam.optics.numerics import bracketed
from kcam.optics.rendering.borders import extend
from kcam.scene import Scene
from kcam.sensor import ColourFilter, DarkCurrent, Exposure, Mosaic, ReadNoise, ShotNoise, Transmission
from kcam.sensor.mosaic import pattern_tile
from kcam.sensor.random_stage import Mean

UNSEEN = 1e-8
"""Of what is recorded, sums over the bands that do not count."""

FEW = 64
"""Pixels, or patches, that are few."""

_PATCH = 4  # side of patches of light [pixels]
_PALE = 0.03  # of the energy of contrast, that hues may leave out
_WHOLE = 3e-3, 1e-4  # of a scene's light, that planes of fewer spectra may leave out: errors differ by 1 %


def linear(camera: Camera) -> bool:
    """Whether a camera's noiseless raw is linear in light that is not clipped, and its PSF one all over: as far as that
    is known, of stages of these very classes without hooks.
    """
    known = {Clip, ColourFilter, DarkCurrent, Exposure, Imaging, Mosaic, ReadNoise, ShotNoise, Transmission}
    stages: list[Any] = [stage.stage if isinstance(stage, Mean) else stage for stage in camera]
    one = all(getattr(stage.lens, "positions", None) is None for stage in stages if isinstance(stage, Imaging))
    hooked = any(stage._forward_hooks or stage._forward_pre_hooks for stage in (*camera, *stages))
    return one and not hooked and all(type(stage) in known for stage in stages)


def recorded(camera: Camera, scene: Scene) -> Tensor | None:
    """Sums over the bands (R, L) whose squares add up to what a pixel records, in the mean over pixels; None: bands."""
    weights, pairs = None, None
    for stage in camera:
        if isinstance(stage, ColourFilter):
            seen: Any = camera.resolve(scene).colour_filter  # the same, behind what stands before it
            weights = seen.contraction(scene.wavelengths).detach().double().cpu()
            pairs = torch.eye(len(weights), dtype=torch.float64)
            if stage.is_tile:
                alpha = stage.alpha().detach().double().cpu().flatten(0, 1)
                pairs = alpha.T @ alpha / len(alpha)
        elif isinstance(stage, Mosaic):
            tile = pattern_tile(stage.pattern).flatten()
            count = len(scene.wavelengths) if weights is None else len(weights)
            pairs = tile.bincount(minlength=count).double().diag() / len(tile)
    if pairs is None:
        return None
    sizes, sums = torch.linalg.eigh(pairs)
    seen = sizes > UNSEEN * sizes[-1]
    sums = (sums[:, seen] * sizes[seen].sqrt()).T
    return sums if weights is None else sums @ weights


def _factors(scene: Scene) -> tuple[Tensor, Tensor]:
    """The planes of a scene, at least float32, and the spectrum of each, (K, L)."""
    planes = scene.coefficients.detach()
    spectra = torch.eye(planes.shape[1]) if scene.spectra is None else scene.spectra.detach()
    return planes.to(torch.promote_types(planes.dtype, torch.float32)), spectra


def compressed(scene: Scene) -> Scene:
    """The scene as planes of the fewest spectra that leave out `_WHOLE` of its light at most: of its square root, so
    that the rest counts beside a few bright lights, and dim items beside bright ones.
    """
    planes, spectra = _factors(scene)
    spectra, radiance = spectra.to(planes), planes
    if scene.spectra is not None:
        radiance = torch.einsum("lk,bkhw->blhw", torch.linalg.qr(spectra.T).R, planes)  # as long as the radiance
    light = radiance.square().sum(1, keepdim=True).sqrt().clamp(min=torch.finfo(planes.dtype).tiny)
    even = (light.sqrt() * light.sum((-2, -1), keepdim=True).sqrt()).reciprocal()
    flat = (planes * even).transpose(0, 1).flatten(1)
    energies, directions = torch.linalg.eigh((spectra.T @ (flat @ flat.T) @ spectra).double())
    left_out = energies.clamp(min=0).cumsum(0)
    for share in _WHOLE:
        few = directions[:, int((left_out[:-1] <= share**2 * left_out[-1]).sum()) :].to(planes)
        if few.shape[1] < len(flat):
            with contextlib.suppress(ValueError):  # light would be negative somewhere, by more than a scene lets pass
                return replace(scene, coefficients=torch.einsum("bkhw,kr->brhw", planes, spectra @ few), spectra=few.T)
    return scene


def hues(scene: Scene, weights: Tensor | None) -> Tensor:
    """What is recorded of each pixel in sums of bands (R, L), or in all bands, as the fewest planes (B, J, H, W) whose
    squares add up to it, but for `_PALE` of its contrast: of light that all bands blur alike.
    """
    planes, spectra = _factors(scene)
    spectra = spectra.double().cpu()
    sums = spectra if weights is None else spectra @ weights.double().cpu().T  # (K, R)
    flat = planes.flatten(2) / planes.flatten(1).norm(dim=1).clamp(min=torch.finfo(planes.dtype).tiny)[:, None, None]
    grams = (flat @ flat.mT).double().cpu().sum(0)
    means = flat.mean(-1).double().cpu()
    even = flat.shape[-1] * means.T @ means
    energies, directions = torch.linalg.eigh(sums.T @ grams @ sums)
    contrast = float((sums.T @ (grams - even) @ sums).trace())
    few = energies.clamp(min=0).cumsum(0) > _PALE * contrast
    few[-1] = True
    return torch.einsum("bkhw,kj->bjhw", planes, (sums @ directions[:, few]).to(planes))


def contrast(planes: Tensor) -> Tensor:
    """The energy of what differs from their means, of that of planes (B, K, H, W): (B,)."""
    flat = planes.detach().double().cpu().flatten(2)
    return flat.var(-1, correction=0).sum(1) / flat.square().mean(-1).sum(1).clamp(min=1e-300)


def few_lights(light: Tensor) -> Tensor:
    """Whether a few pixels, or patches, have most of the energy of light (B, 1, H, W): (B,)."""
    patches = functional.avg_pool2d(light, min(_PATCH, *light.shape[-2:]), ceil_mode=True)
    few = torch.minimum(lights(light), lights(patches)) < FEW
    return few & (light.flatten(1).amax(1) > 0).cpu()


def lights(light: Tensor) -> Tensor:
    """How many pixels have most of the energy of each (B, 1, H, W): (B,), from 1 on."""
    energies = light.double().flatten(1).cpu().square()
    return (energies.sum(1).square() / energies.square().sum(1).clamp(min=1e-300)).clamp(min=1)


def blurred(planes: Tensor, transfer: Tensor, frequencies: Tensor, border: str) -> tuple[Tensor, Tensor]:
    """Energy of light in layers (B, Z, H, W), blurred by transfer functions along x and y (Z, 2, F) at frequencies
    (F,): in the picture, and with as much again around it, (B,).
    """
    height, width = planes.shape[-2:]
    light = torch.fft.rfft2(extend(planes, (height + 1, width + 1), border))
    for axis, own in enumerate((torch.fft.rfftfreq(2 * width), torch.fft.fftfreq(2 * height))):
        low, share = bracketed(frequencies, own.abs().to(frequencies))
        along = torch.lerp(transfer[:, axis, low], transfer[:, axis, low + 1], share.to(transfer.dtype))
        along = torch.where(own < 0, along.conj(), along).to(light)
        light = light * (along[:, :, None] if axis else along[:, None])
    seen = torch.fft.irfft2(light.sum(1), s=(2 * height, 2 * width)).square()
    inside = seen.narrow(1, (height + 1) // 2, height).narrow(2, (width + 1) // 2, width)
    return inside.sum((1, 2)).double().cpu(), seen.sum((1, 2)).double().cpu()

"""What the augmentations by wave optics share: each sample is convolved with PSFs of its own."""

from __future__ import annotations

import math
from typing import TypedDict

import torch
from torch import Tensor

from kcam.augmentation.base import CameraAugmentation, wavelengths_of
from kcam.augmentation.distributions import Draw
from kcam.compiled import uncompiled
from kcam.optics import batch_psf
from kcam.optics.rendering.convolution import Convolution
from kcam.units import check_pixel_pitch, mm, nm, um, wavelength_grid

DESIGN = 550 * nm
"""Where aberrations are stated, and where a lens is in focus."""
FOCAL_LENGTH, PIXEL_PITCH = 8 * mm, 4 * um
"""Of a machine-vision camera; a phone has 4.3 mm and 1.4 um, a full-frame camera 50 mm and 6 um."""
FOCAL_LENGTH_RANGE = (1e-4, 10.0)
_PLANES_IN_CACHE = 4  # that are convolved at once


class BlurOptions(TypedDict, total=False):
    """What every augmentation by PSFs takes beside its own arguments: see `RandomBlur`."""

    pixel_pitch: float
    outside: float
    wavelengths: Tensor | list[float] | None
    same_on_batch: bool
    p: float
    keepdim: bool


class RandomBlur(CameraAugmentation):
    """Base of the augmentations that convolve each sample with PSFs of its own: a round thin lens, drawn per sample.

    The PSFs come from `optics.batch_psf` (paraxial, integrated over the pixels): the same as `optics.Imaging` of such a
    lens with propagator="fresnel", the psf_shape of the sample, and renormalise=True.

    Args:      pixel_pitch: [m]. outside: share of the light that the window of a PSF may leave out, which is then
                   spread over the window; smaller is slower. wavelengths: of the channels [m]; None: see `base`.
    """

    together = True
    """Whether the PSFs of a batch share tables, and are found at once."""

    def __init__(
        self,
        draws: dict[str, Draw],
        *,
        pixel_pitch: float = PIXEL_PITCH,
        outside: float = 0.01,
        wavelengths: Tensor | list[float] | None = None,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        if not 1e-4 <= outside < 1:
            raise ValueError(f"outside must be a share of the light from 1e-4 to below 1, got {outside:g}.")
        self.pixel_pitch, self.outside = check_pixel_pitch(pixel_pitch), outside
        self.flags = {"pixel_pitch": self.pixel_pitch, "outside": outside}
        self.wavelengths = None if wavelengths is None else wavelength_grid(wavelengths)

    def psf_shape(
        self, picture: tuple[int, int], wavelengths: Tensor, drawn: dict[str, Tensor] | None = None
    ) -> tuple[int, int]:
        """Window [pixels] of the PSFs of a sample with these numbers, (1,) each; without, of the worst there is."""
        return self.window(picture, self.widest(wavelengths) if drawn is None else self.half_width(drawn, wavelengths))

    def window(self, picture: tuple[int, int], half_width: float) -> tuple[int, int]:
        """Pixels for PSFs of this half width [m]: odd, no more than the picture."""
        half = math.ceil(half_width / self.pixel_pitch)
        height, width = (min(2 * half + 1, n + (n + 1) % 2) for n in picture)
        return height, width

    def tail(self, *, radius: float, sensor_distance: float, wavelengths: Tensor) -> float:
        """Radius beyond which diffraction at a round aperture sends `outside` of the light: lambda d / (pi^2 a s)."""
        return float(wavelengths.max()) * sensor_distance / (math.pi**2 * radius * self.outside)

    def widest(self, wavelengths: Tensor) -> float:
        """Half width of the largest PSF in the ranges [m]."""
        raise NotImplementedError(f"{type(self).__name__} does not say how large its PSFs are.")

    def half_width(self, drawn: dict[str, Tensor], wavelengths: Tensor) -> float:
        """Half width of the PSF of a sample with these numbers, (1,) each [m]."""
        return self.widest(wavelengths)

    def psfs(self, drawn: dict[str, Tensor], *, wavelengths: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
        """(B, Z, L, h, w), each of sum 1."""
        raise NotImplementedError(f"{type(self).__name__} does not say what its PSFs are.")

    def bank(self, vergences: Tensor, *, shape: tuple[int, int], like: Tensor, **lens) -> Tensor:
        """`batch_psf` with the light outside the window spread over it."""
        psfs = batch_psf(vergences, pixel_pitch=self.pixel_pitch, shape=shape, dtype=like.dtype, **lens).to(like.device)
        return psfs / psfs.sum((-2, -1), keepdim=True)

    @uncompiled  # its sizes follow from numbers, at each of which a graph would break
    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """One depth: each channel of each sample with its PSF, in a window of its own."""
        rows = zip(signal.split(1), self.kernels(signal, drawn), strict=True)
        return torch.cat([convolve(row, psfs[None]) for row, psfs in rows])

    def kernels(self, signal: Tensor, drawn: dict[str, Tensor]) -> list[Tensor]:
        """The PSFs of each sample, (L, h, w) each."""
        wavelengths, picture = wavelengths_of(signal, self.wavelengths), (signal.shape[-2], signal.shape[-1])
        rows = [{name: value[i : i + 1] for name, value in drawn.items()} for i in range(len(signal))]
        shapes = [self.psf_shape(picture, wavelengths, own) for own in rows]
        if not self.together:
            found = zip(rows, shapes, strict=True)
            return [self.psfs(own, wavelengths=wavelengths, shape=shape, like=signal)[0, 0] for own, shape in found]
        largest = max(height for height, _ in shapes), max(width for _, width in shapes)
        bank = self.psfs(drawn, wavelengths=wavelengths, shape=largest, like=signal)[:, 0]
        kernels = []
        for psfs, shape in zip(bank, shapes, strict=True):
            inside = psfs[:, *(slice((n - own) // 2, (n + own) // 2) for n, own in zip(largest, shape, strict=True))]
            kernels.append(inside / inside.sum((-2, -1), keepdim=True))
        return kernels


def convolve(signal: Tensor, psfs: Tensor) -> Tensor:
    """Each channel of each picture (B,C,H,W) with its own PSF (B,C,h,w), upright; beyond the border it is reflected."""
    picture, window = (signal.shape[-2], signal.shape[-1]), (psfs.shape[-2], psfs.shape[-1])
    sizes = Convolution.of(picture, window, border="reflect", itemsize=signal.element_size(), max_memory=2e9)
    planes, kernels = signal.flatten(0, 1)[:, None], psfs.flatten(0, 1)[:, None]
    # few planes at once stay in a CPU's cache: three times as fast on 28 bands; a GPU wants many
    split = signal.device.type == "cpu" and not torch.compiler.is_compiling()
    at_once = _PLANES_IN_CACHE if split else len(planes)
    parts = [
        sizes.back(sizes.transform(some) * sizes.transfer(their))
        for some, their in zip(planes.split(at_once), kernels.split(at_once), strict=True)
    ]
    return torch.cat(parts).view(signal.shape)

"""Imaging: the light of a scene through a lens onto the sensor, equation (3.1) before the noise.

    I_c = sum_z,l kappa_cl (I_zl * h_zl)

computed with the sum over wavelengths *inside* the Fourier transform: the picture is transformed once per plane of the
scene's factors, and back once per channel, not once per band.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.cache import ValueCache, fingerprint
from kcam.context import Context, Stage
from kcam.optics.lens import Lens
from kcam.optics.propagation import PHYSICS, Propagator, choose
from kcam.optics.psf import Query, ray_displacement
from kcam.optics.transforms import fast_length
from kcam.precision import full_precision
from kcam.scene import Scene
from kcam.units import check_distances, check_pixel_pitch, wavelength_grid

if TYPE_CHECKING:
    from kcam.sensor.colour_filter import ColourFilter

BORDERS = ("reflect", "replicate", "periodic", "zero")
OUTSIDE_SHARE = 1e-3  # of the light that the default window may leave out
LAYER_WAVES = 0.125  # defocus between neighbouring depth layers
_BANDS_AT_ONCE = 4  # at most, in the buffer of a contraction: small enough to stay in the processor's cache
_COVERAGE_FLOOR = 1e-4  # below it a layer is hidden by nearer ones, and its share is lost in the FFT's rounding


class Imaging(Stage):
    """The light of a scene through a lens onto the pixels.

    Args:
        lens: the optics.
        pixel_pitch: [m]. fill_factor: light-sensitive share of a pixel; the irradiance is its mean over that square.
        propagator, method, samples: as in `Lens.psf`. A number of samples freezes the pupil grid, which otherwise
            follows the parameters in steps: give it together with psf_shape where a camera is differenced. A propagator
            may also be a row of one's own, an `optics.propagation.Propagator`; such a camera cannot be saved.
        integrate: the light over each pixel; False takes point samples at the pixels' centres instead.
        bands: number of wavelengths that have a PSF of their own; None: all. Fewer: neighbouring bands share the PSF of
            their group's mean wavelength, whatever their number.
        psf_shape: (H, W) of the PSF's window in pixels; None: see `psf_window`.
        layers: number of depth layers over the range of a depth map; None: see `depth_layers`.
        interpolate: between the layers, linearly in vergence; False puts each pixel into its nearest layer.
        border: what lies beyond the picture: reflect, replicate, periodic or zero.
        distance: of a plain tensor [m]; None: where the lens is focused.
        max_memory: bytes that the transforms may take; bands are split to stay below, with the same result.
    Raises: ValueError for an unknown propagator or border, a pitch not in metres, a shape or count that is not
        positive.
    """

    def __init__(
        self,
        lens: Lens,
        *,
        pixel_pitch: float = 4e-6,
        propagator: str | Propagator = "nonparaxial",
        method: str | None = None,
        samples: int | None = None,
        integrate: bool = True,
        bands: int | None = None,
        psf_shape: tuple[int, int] | None = None,
        layers: int | None = None,
        interpolate: bool = True,
        border: str = "reflect",
        fill_factor: float = 1.0,
        distance: float | None = None,
        max_memory: float = 2e9,
    ) -> None:
        super().__init__()
        if not isinstance(lens, Lens):
            raise TypeError(f"Imaging takes an optics.Lens, got {type(lens).__name__}.")
        if not isinstance(propagator, Propagator) and propagator not in PHYSICS:
            raise ValueError(f"unknown propagator {propagator!r}; known: {', '.join(PHYSICS)}.")
        if border not in BORDERS:
            raise ValueError(f"unknown border {border!r}; known: {', '.join(BORDERS)}.")
        if layers is not None and layers < 1:
            raise ValueError(f"layers must be a positive number of depth layers, or None, got {layers}.")
        if bands is not None and bands < 1:
            raise ValueError(f"bands must be a positive number of wavelengths, or None for all, got {bands}.")
        if distance is not None:
            check_distances(distance)
        if not max_memory > 0:
            raise ValueError(f"max_memory must be a positive number of bytes, got {max_memory:g}.")
        self.lens = lens
        self.pixel_pitch = check_pixel_pitch(pixel_pitch)
        self.propagator, self.method, self.samples = propagator, method, samples
        self.psf_shape = None if psf_shape is None else (int(psf_shape[0]), int(psf_shape[1]))
        self.integrate, self.bands = integrate, bands
        self.layers, self.interpolate, self.border, self.fill_factor = layers, interpolate, border, fill_factor
        self.distance, self.max_memory = distance, float(max_memory)
        self._bank_cache, self._transfer_cache = ValueCache(), ValueCache()
        query = self._query(wavelength_grid([550e-9]), torch.zeros(1), self.psf_shape or (1, 1), torch.empty(0))
        if method is not None:
            choose(query, propagator=propagator, method=method)  # refuses a method that does not exist

    def changed(self, **arguments: Any) -> Imaging:
        """The same stage with some of its constructor's arguments changed; it shares the lens and has kept nothing."""
        own = {name: getattr(self, name) for name in inspect.signature(Imaging).parameters}
        return Imaging(**(own | arguments))

    def provides(self) -> dict[str, Any]:
        """The optics, for exposure in physical units."""
        return {"lens": self.lens, "pixel_pitch": self.pixel_pitch, "fill_factor": self.fill_factor}

    def forward(
        self, scene: Scene | Tensor, context: Context | None = None, *, colour_filter: ColourFilter | None = None
    ) -> Tensor:
        """Mean irradiance over each pixel.

        Args:
            scene: a `Scene`, or bands (B, L, H, W) of `context`'s wavelengths (28 from 420 to 720 nm unless told).
            colour_filter: absorbed if given: the result is then the filter's, at the cost of its channels, not its
                bands.
        Returns:   (B, L, H, W), or what the filter gives; dtype and device of the scene.
        Raises:    ValueError for a tensor of the wrong rank or number of bands.
        """
        if not isinstance(scene, Scene):
            scene = self._as_scene(scene, context or Context())
        planes = scene.coefficients
        working = planes if planes.dtype in (torch.float32, torch.float64) else planes.float()
        contraction = None if colour_filter is None else colour_filter.contraction(scene.wavelengths)
        with full_precision(working.device):
            result = self._render(scene, working, contraction).to(planes.dtype)
        return result if colour_filter is None else colour_filter.finish(result)

    def psf_window(self, wavelengths: Tensor, *, vergences: Tensor, picture: tuple[int, int]) -> tuple[int, int]:
        """Window of the PSF in pixels: at most 0.1 % of the light outside, or the window is the picture.

        Half width = blur + lambda d P / (2 pi^2 A 1e-3): the rays' displacement, and the tail that diffraction at a
        rim of length P around an area A spreads beyond a radius.
        """
        if self.psf_shape is not None:
            return self.psf_shape
        query = self._query(wavelengths, vergences, (1, 1), torch.empty(0, dtype=torch.float64))
        blur = float((ray_displacement(query) + self.lens.pixel_phase_displacement(query)).max())
        tail = float(wavelengths.max()) * float(query.sensor_distance.detach()) / (2 * math.pi**2 * OUTSIDE_SHARE)
        half = math.ceil((blur + tail * self.lens.aperture.rim_per_area()) / self.pixel_pitch)
        height, width = (min(2 * half + 1, n + (n + 1) % 2) for n in picture)
        return height, width

    def depth_layers(self, depth: Tensor, wavelengths: Tensor) -> Tensor:
        """Vergences of the layers that a depth map is cut into, ascending (Z,) [1/m]: equal steps of <= 0.125 waves.

        A step dV in vergence is a^2 dV / (2 lambda) waves of defocus at the rim.
        """
        vergence = 1 / depth.detach().to(torch.float64)
        low, high = float(vergence.min()), float(vergence.max())
        if low == high:
            return torch.tensor([low], dtype=torch.float64)
        count = self.layers
        if count is None:
            semi = float(self.lens.aperture.semi_aperture().detach())
            count = 1 + math.ceil((high - low) * semi**2 / (2 * float(wavelengths.min())) / LAYER_WAVES)
        if count == 1:
            return torch.tensor([(low + high) / 2], dtype=torch.float64)
        return torch.linspace(low, high, count, dtype=torch.float64)

    # ---- scene and optics ------------------------------------------------------------------------------------------

    def _as_scene(self, bands: Tensor, context: Context) -> Scene:
        if not isinstance(bands, Tensor) or bands.ndim != 4:
            got = tuple(bands.shape) if isinstance(bands, Tensor) else type(bands).__name__
            raise ValueError(f"Imaging takes a Scene or bands (B, L, H, W), got {got}.")
        if bands.shape[1] != context.wavelengths.numel():
            raise ValueError(
                f"{bands.shape[1]} bands do not match {context.wavelengths.numel()} wavelengths; give a Scene with its "
                "own, or as many bands as wavelengths."
            )
        distance = self.distance if self.distance is not None else self.lens.focus_distance
        if not distance > 0:
            raise ValueError(
                f"the lens is focused on {distance:g} m, behind itself; say where the bands are: Imaging(distance=2.0)."
            )
        light = {} if context.illuminant is None else {"illuminant": context.illuminant}
        return Scene.from_bands(
            bands, wavelengths=context.wavelengths, depth=distance, luminance=context.luminance, **light
        )

    def _query(self, wavelengths: Tensor, vergences: Tensor, shape: tuple[int, int], like: Tensor) -> Query:
        distances = 1 / vergences.detach().to(torch.float64)
        return self.lens.query(
            wavelengths,
            distances=distances,
            pixel_pitch=self.pixel_pitch,
            shape=shape,
            samples=self.samples,
            fill_factor=self.fill_factor,
            integrate=self.integrate,
            dtype=like.dtype,
            device=like.device,
        )

    def psf_bank(self, wavelengths: Tensor, *, vergences: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
        """PSFs of the bands of a scene, (Z, L, h, w) in the dtype and on the device of `like`; kept while nothing
        changes.
        """
        groups = list(wavelengths.argsort().tensor_split(min(self.bands or len(wavelengths), len(wavelengths))))
        query = self._query(wavelengths, vergences, shape, like)
        if len(groups) < len(wavelengths):
            query = replace(query, wavelengths=torch.stack([wavelengths[group].mean() for group in groups]))

        def build() -> Tensor:
            psfs = choose(query, propagator=self.propagator, method=self.method)(query)
            if len(groups) == len(wavelengths):
                return psfs
            owner = torch.empty(len(wavelengths), dtype=torch.long)
            for index, group in enumerate(groups):
                owner[group] = index
            return psfs[:, owner.to(psfs.device)]

        if torch.is_grad_enabled() and any(p.requires_grad for p in self.lens.parameters()):
            return build()
        return self._bank_cache.get(self._optics_key(wavelengths, vergences, shape, like), build)

    def _optics_key(self, wavelengths: Tensor, vergences: Tensor, shape: tuple[int, int], like: Tensor) -> tuple:
        how = (self.propagator, self.method, self.samples, self.integrate, self.bands)
        pixel = (self.pixel_pitch, self.fill_factor)
        return (fingerprint(self.lens), how, pixel, wavelengths, vergences, shape, str(like.dtype), str(like.device))

    def _layer_shares(self, depth: Tensor, vergences: Tensor) -> Tensor:
        """Share of each pixel in each layer, linear in vergence between neighbours or all in the nearest: (B, Z, H, W),
        sums to 1.
        """
        position = (1 / depth - vergences[0].item()) / float(vergences[1] - vergences[0])
        position = position if self.interpolate else position.round()
        layers = torch.arange(vergences.numel(), device=depth.device, dtype=torch.float64)
        return torch.clamp(1 - (position - layers[:, None, None]).abs(), min=0)

    # ---- rendering -------------------------------------------------------------------------------------------------

    def _render(self, scene: Scene, planes: Tensor, contraction: Tensor | None) -> Tensor:
        batch, _, height, width = planes.shape
        bands = scene.wavelengths.numel()
        channels = bands if contraction is None else contraction.shape[0]
        if planes.numel() == 0:
            return planes.new_zeros(batch, channels, height, width) + planes.sum()
        spectra = None if scene.spectra is None else scene.spectra.to(planes)
        weights = None if contraction is None else contraction.to(planes)
        depth = torch.as_tensor(scene.depth, dtype=torch.float64, device=planes.device)
        vergences = self.depth_layers(depth, scene.wavelengths)
        shares = None if vergences.numel() == 1 else self._layer_shares(depth, vergences).to(planes)
        if shares is not None:
            present = (shares.flatten(2).amax(dim=(0, 2)) > 0).cpu()
            vergences, shares = vergences[present], shares[:, present.to(shares.device)]
        window = self.psf_window(scene.wavelengths, vergences=vergences, picture=(height, width))
        # a bank of PSFs for as many layers as fit into a quarter of the memory
        per_layer = bands * window[0] * window[1] * planes.element_size()
        length = max(1, int(self.max_memory / 4 // per_layer))
        layers = _Layers(planes, shares)
        for start in range(0, vergences.numel(), length):
            some = vergences[start : start + length]
            psfs = self.psf_bank(scene.wavelengths, vergences=some, shape=window, like=planes)
            renderer = _Renderer(self, psfs, spectra=spectra, weights=weights, picture=(height, width))
            layers.add(renderer, first=start)
        return layers.light


class _Renderer:
    """Convolves pictures with a bank of PSFs (Z, L, h, w), contracted to the channels."""

    def __init__(
        self,
        imaging: Imaging,
        psfs: Tensor,
        *,
        spectra: Tensor | None,
        weights: Tensor | None,
        picture: tuple[int, int],
    ) -> None:
        self.imaging, self.psfs, self.spectra, self.weights = imaging, psfs, spectra, weights
        after = imaging.border != "zero"  # zeros may share their place with those before the picture
        window = (psfs.shape[-2], psfs.shape[-1])
        rows, columns = (fast_length(n + (m - 1 if after else m // 2)) for n, m in zip(picture, window, strict=True))
        size = (rows, columns)
        plane = 4 * size[0] * size[1] * psfs.element_size()
        self.plan = _Convolution(
            picture=picture,
            window=window,
            border=imaging.border,
            size=size,
            bands=max(1, min(_BANDS_AT_ONCE, int(imaging.max_memory // plane))),
        )

    def blur(self, planes: Tensor, *, layer: int) -> Tensor:
        """The scene's planes (B, K, H, W) through the PSFs of one layer: (B, C, H, W)."""
        psfs = self.psfs[layer]
        if self.weights is None:
            return self._per_band(planes, psfs)
        if self.spectra is not None and self.weights.shape[0] * self.spectra.shape[0] <= psfs.shape[0]:
            return self._by_kernels(planes, psfs, self.weights, self.spectra)
        kept = self._kept(psfs, (), lambda: self.plan.transfer(psfs))
        return _Contraction.apply(planes, psfs, self.spectra, self.weights, kept, self.plan)

    def coverage(self, share: Tensor, *, layer: int) -> Tensor:
        """How a layer's mask (B, 1, H, W) spreads in each channel, relative to the PSFs' own sum: (B, C, H, W)."""
        psfs = self.psfs[layer]
        kernels = psfs if self.weights is None else torch.einsum("cl,lyx->cyx", self.weights, psfs)
        kernels = kernels / kernels.sum((-2, -1), keepdim=True)
        return self.plan.back(self.plan.transform(share) * self.plan.transfer(kernels))

    def _per_band(self, planes: Tensor, psfs: Tensor) -> Tensor:
        """Each band by itself, for a sensor that sees all bands."""

        def band(planes: Tensor, psf: Tensor, index: int) -> Tensor:
            plane = (
                planes[:, index]
                if self.spectra is None
                else torch.einsum("bkhw,k->bhw", planes, self.spectra[:, index])
            )
            return self.plan.back(self.plan.transform(plane) * self.plan.transfer(psf))

        # between the forward and the backward pass only the results are kept, not 28 spectra
        bands = (
            checkpoint(band, planes, psfs[i], i, use_reentrant=False)
            if torch.is_grad_enabled()
            else band(planes, psfs[i], i)
            for i in range(psfs.shape[0])
        )
        return torch.stack(list(bands), dim=1)

    def _by_kernels(self, planes: Tensor, psfs: Tensor, weights: Tensor, spectra: Tensor) -> Tensor:
        """sum_k (sum_l kappa_cl S_kl h_l) * C_k: for few channels and planes the PSFs are contracted, not the
        spectra.
        """

        def transfers() -> Tensor:
            return self.plan.transfer(torch.einsum("cl,kl,lyx->ckyx", weights, spectra, psfs))

        kept = self._kept(psfs, (weights, spectra), transfers)
        spectrum = self.plan.transform(planes)
        channels = transfers() if kept is None else kept
        return torch.stack([self.plan.back((spectrum * channel).sum(1)) for channel in channels], dim=1)

    def _kept(self, psfs: Tensor, others: tuple[Tensor, ...], build: Callable[[], Tensor]) -> Tensor | None:
        """Transfer functions kept between calls while what they come from is the same, or None: too large, or
        training.
        """
        count = psfs.shape[0] if not others else others[0].shape[0] * others[1].shape[0]
        size = count * self.plan.size[0] * self.plan.size[1] * psfs.element_size()
        trained = any(t.requires_grad for t in (psfs, *others))
        if trained or self.psfs.shape[0] > 1 or size > self.imaging.max_memory / 4:
            return None
        return self.imaging._transfer_cache.get((psfs, *others, self.plan.size), build)


@dataclass(frozen=True)
class _Convolution:
    """Sizes of a convolution by FFT, and its parts.

    The picture is upright, which turns the PSF by 180 degrees: a correlation, so transfer functions are conjugated,
    and the window's origin needs no shift: the picture is extended by window // 2 before its first pixel.
    """

    picture: tuple[int, int]
    window: tuple[int, int]
    border: str
    size: tuple[int, int]
    bands: int  # at once

    def transform(self, planes: Tensor) -> Tensor:
        """Spectrum of planes (..., H, W) with their border."""
        return torch.fft.rfft2(_extend(planes, self.window, self.border), s=self.size)

    def transfer(self, kernels: Tensor) -> Tensor:
        """Conjugate transfer functions of kernels (..., h, w)."""
        along_x = torch.fft.rfft(kernels, n=self.size[1])  # only the kernel's own rows, before the zero rows
        # conjugated in memory: a lazy conjugate would be copied at every product
        return torch.fft.fft(along_x, n=self.size[0], dim=-2).conj_physical_()

    def back(self, spectrum: Tensor) -> Tensor:
        """The picture of a spectrum."""
        return torch.fft.irfft2(spectrum, s=self.size)[..., : self.picture[0], : self.picture[1]]


class _Contraction(torch.autograd.Function):
    """sum_l kappa_cl H_l (sum_k S_kl C_k), a few bands at a time in one small buffer; nothing but the inputs is kept.

    All bands at once would take hundreds of megabytes, and most of the time would go into touching them first.
    """

    @staticmethod
    def forward(ctx, planes, psfs, spectra, weights, kept, plan):
        ctx.save_for_backward(planes, psfs, spectra, weights, kept)
        ctx.plan = plan
        batch, bands, channels = planes.shape[0], psfs.shape[0], weights.shape[0]
        factors = None if spectra is None else plan.transform(planes)
        result = []
        for b in range(batch):
            total = planes.new_zeros(channels, 2 * plan.size[0] * (plan.size[1] // 2 + 1))
            buffer = planes.new_empty(plan.bands, plan.size[0], plan.size[1] // 2 + 1, 2)
            for start in range(0, bands, plan.bands):
                part = range(start, min(start + plan.bands, bands))
                for slot, index in enumerate(part):
                    spectrum = _band_spectrum(plan, planes, spectra, factors, b, index)
                    transfer = _band_transfer(plan, psfs, kept, index)
                    torch.mul(spectrum, transfer, out=torch.view_as_complex(buffer[slot]))
                total.addmm_(weights[:, part.start : part.stop], buffer[: len(part)].flatten(1))
            result.append(plan.back(torch.view_as_complex(total.view(channels, plan.size[0], -1, 2))))
        return torch.stack(result)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad):
        planes, psfs, spectra, weights, kept = ctx.saved_tensors
        plan = ctx.plan
        need_planes, need_psfs, need_spectra, need_weights = ctx.needs_input_grad[:4]
        height, width = plan.window
        factors = None if spectra is None else plan.transform(planes)
        d_planes = torch.zeros_like(planes) if need_planes else None
        d_factors = torch.zeros_like(factors) if need_planes and spectra is not None else None
        d_psfs = torch.zeros_like(psfs) if need_psfs else None
        d_spectra = torch.zeros_like(spectra) if need_spectra and spectra is not None else None
        d_weights = torch.zeros_like(weights) if need_weights else None
        with full_precision(grad.device):
            for b in range(planes.shape[0]):
                # the adjoint of cropping is a picture with nothing around it; of a correlation, a convolution
                onto = torch.fft.rfft2(grad[b], s=plan.size)
                flat = torch.view_as_real(onto).flatten(1)
                for index in range(psfs.shape[0]):
                    mixed = (weights[:, index] @ flat).view(*onto.shape[1:], 2)
                    mixed = torch.view_as_complex(mixed)
                    transfer = _band_transfer(plan, psfs, kept, index)
                    if need_planes or need_spectra:
                        d_band = mixed * transfer.conj()
                        if spectra is None and need_planes:
                            extended = torch.fft.irfft2(d_band, s=plan.size)
                            d_planes[b, index] = _extend_adjoint(extended, plan)
                        if d_factors is not None:
                            d_factors[b].add_(spectra[:, index, None, None] * d_band)
                        if d_spectra is not None:
                            d_spectra[:, index] += _inner(factors[b], d_band, plan)
                    if need_psfs or need_weights:
                        spectrum = _band_spectrum(plan, planes, spectra, factors, b, index)
                        if need_psfs:
                            d_psf = torch.fft.irfft2(spectrum * mixed.conj(), s=plan.size)
                            d_psfs[index] += d_psf[:height, :width]
                        if need_weights:
                            d_weights[:, index] += _inner(onto, spectrum * transfer, plan)
            if d_factors is not None:
                d_planes = _extend_adjoint(torch.fft.irfft2(d_factors, s=plan.size), plan)
        return d_planes, d_psfs, d_spectra, d_weights, None, None


def _band_spectrum(
    plan: _Convolution, planes: Tensor, spectra: Tensor | None, factors: Tensor | None, b: int, index: int
) -> Tensor:
    if spectra is None or factors is None:
        return plan.transform(planes[b, index])
    mixed = spectra[:, index] @ torch.view_as_real(factors[b]).flatten(1)
    return torch.view_as_complex(mixed.view(*factors.shape[2:], 2))


def _band_transfer(plan: _Convolution, psfs: Tensor, kept: Tensor | None, index: int) -> Tensor:
    return plan.transfer(psfs[index]) if kept is None else kept[index]


def _inner(a: Tensor, b: Tensor, plan: _Convolution) -> Tensor:
    """Sum over the picture's plane of two real functions, from their half spectra (C, ...) and (...), by Parseval."""
    product = a.real * b.real + a.imag * b.imag
    double = product.new_full((product.shape[-1],), 2.0)
    double[0] = 1.0
    if plan.size[1] % 2 == 0:
        double[-1] = 1.0
    return (product * double).sum((-2, -1)) / (plan.size[0] * plan.size[1])


def _extend_adjoint(extended: Tensor, plan: _Convolution) -> Tensor:
    """Transpose of `_extend` and of the zeros up to the transform's length: fold the border back onto the picture."""
    for dim, n, m in zip((-2, -1), plan.picture, plan.window, strict=True):
        before, after = m // 2, (m - 1) // 2
        if plan.border == "zero":
            extended = extended.narrow(dim, before, n)
            continue
        index = _border_index(torch.arange(-before, n + after, device=extended.device), n, plan.border)
        shape = list(extended.shape)
        shape[dim] = n
        used = extended.narrow(dim, 0, n + before + after)
        extended = extended.new_zeros(shape).index_add_(dim, index, used)
    return extended


def _extend(planes: Tensor, window: tuple[int, int], border: str) -> Tensor:
    """The picture with the border that the window reaches: window // 2 before, the rest after."""
    for dim, m in zip((-2, -1), window, strict=True):
        n = planes.shape[dim]
        before, after = m // 2, (m - 1) // 2
        if border == "zero":
            pad = (0, 0, before, 0) if dim == -2 else (before, 0)
            planes = torch.nn.functional.pad(planes, pad)
            continue
        index = torch.arange(-before, n + after, device=planes.device)
        planes = planes.index_select(dim, _border_index(index, n, border))
    return planes


def _border_index(index: Tensor, n: int, border: str) -> Tensor:
    """Which pixel stands at each position beyond the picture; reflections repeat where the window is larger."""
    if border == "replicate" or n == 1:
        return index.clamp(0, n - 1)
    if border == "periodic":
        return index % n
    folded = index % (2 * n - 2)
    return torch.where(folded < n, folded, 2 * n - 2 - folded)


class _Layers:
    """Depth layers from far to near: each is blurred with its own coverage and laid over what is behind it.

    E_k = sum over layers up to k of (K * m),  l_k = (h * m_k I) / E_k,  a_k = (K * m_k) / E_k,  out <- l_k + (1 - a_k)
    out

    with K the PSFs weighted by the channel's filter, relative to their own sum: coverage per *channel*, so that the
    sum over wavelengths stays inside the transform. Dividing by E_k extends each layer behind the nearer ones, whose
    blurred edge would otherwise show black. Where all layers share one PSF this is exactly the plain convolution.
    Source: Ikoma et al., Depth from Defocus with Learned Optics, ICCP 2021 (normalised over-compositing).
    """

    def __init__(self, planes: Tensor, shares: Tensor | None) -> None:
        self.planes, self.shares = planes, shares
        self.light: Tensor = planes.new_zeros(())
        self._covered: Tensor = planes.new_zeros(())

    def add(self, renderer: _Renderer, *, first: int) -> None:
        """Lay the layers of one bank of PSFs, `first` and the following, over those before."""
        if self.shares is None:
            self.light = renderer.blur(self.planes, layer=0)
            return
        for layer in range(renderer.psfs.shape[0]):
            share = self.shares[:, first + layer : first + layer + 1]
            light = renderer.blur(self.planes * share, layer=layer)
            cover = renderer.coverage(share, layer=layer)
            self._covered = self._covered + cover
            floor = self._covered.clamp(min=_COVERAGE_FLOOR)
            opacity = (cover / floor).clamp(0, 1)
            self.light = light / floor + (1 - opacity) * self.light

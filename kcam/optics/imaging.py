"""Imaging: the light of a scene through a lens onto the sensor, equation (3.1) before the noise.

    I_c = sum_z,l kappa_cl (I_zl * h_zl)

computed with the sum over wavelengths *inside* the Fourier transform: the picture is transformed once per plane of the
scene's factors, and back once per channel, not once per band.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kcam.cache import ValueCache, fingerprint
from kcam.context import Context, Stage
from kcam.optics.lens import Lens
from kcam.optics.propagation import PHYSICS, choose
from kcam.optics.psf import Query, ray_displacement
from kcam.optics.transforms import fast_length, full_precision
from kcam.scene import Scene
from kcam.units import check_distances, check_pixel_pitch, wavelength_grid

if TYPE_CHECKING:
    from kcam.sensor.colour_filter import ColourFilter

BORDERS = ("reflect", "replicate", "periodic", "zero")
OUTSIDE_SHARE = 1e-3  # of the light that the default window may leave out
LAYER_WAVES = 0.125  # defocus between neighbouring depth layers
_COVERAGE_FLOOR = 1e-4  # below it a layer is hidden by nearer ones, and its share is lost in the FFT's rounding


class Imaging(Stage):
    """The light of a scene through a lens onto the pixels.

    Args:
        lens: the optics.
        pixel_pitch: [m]. fill_factor: light-sensitive share of a pixel; the irradiance is its mean over that square.
        propagator, method: as in `Lens.psf`.
        psf_shape: (H, W) of the PSF's window in pixels; None: see `psf_window`.
        layers: number of depth layers over the range of a depth map; None: see `depth_layers`.
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
        propagator: str = "nonparaxial",
        method: str | None = None,
        psf_shape: tuple[int, int] | None = None,
        layers: int | None = None,
        border: str = "reflect",
        fill_factor: float = 1.0,
        distance: float | None = None,
        max_memory: float = 2e9,
    ) -> None:
        super().__init__()
        if not isinstance(lens, Lens):
            raise TypeError(f"Imaging takes an optics.Lens, got {type(lens).__name__}.")
        if propagator not in PHYSICS:
            raise ValueError(f"unknown propagator {propagator!r}; known: {', '.join(PHYSICS)}.")
        if border not in BORDERS:
            raise ValueError(f"unknown border {border!r}; known: {', '.join(BORDERS)}.")
        if layers is not None and layers < 1:
            raise ValueError(f"layers must be a positive number of depth layers, or None, got {layers}.")
        if distance is not None:
            check_distances(distance)
        if not max_memory > 0:
            raise ValueError(f"max_memory must be a positive number of bytes, got {max_memory:g}.")
        self.lens = lens
        self.pixel_pitch = check_pixel_pitch(pixel_pitch)
        self.propagator, self.method = propagator, method
        self.psf_shape = None if psf_shape is None else tuple(psf_shape)
        self.layers, self.border, self.fill_factor = layers, border, fill_factor
        self.distance, self.max_memory = distance, float(max_memory)
        self._bank_cache, self._transfer_cache = ValueCache(), ValueCache()
        query = self._query(wavelength_grid([550e-9]), torch.zeros(1), self.psf_shape or (1, 1), torch.empty(0))
        if method is not None:
            choose(query, propagator=propagator, method=method)  # refuses a method that does not exist

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
        return tuple(min(2 * half + 1, n + (n + 1) % 2) for n in picture)

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
            fill_factor=self.fill_factor,
            dtype=like.dtype,
            device=like.device,
        )

    def _psfs(self, wavelengths: Tensor, vergences: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
        """(Z, L, h, w) in the dtype and on the device of `like`, kept while nothing changes."""
        query = self._query(wavelengths, vergences, shape, like)

        def build() -> Tensor:
            return choose(query, propagator=self.propagator, method=self.method)(query)

        if torch.is_grad_enabled() and any(p.requires_grad for p in self.lens.parameters()):
            return build()
        return self._bank_cache.get(self._optics_key(wavelengths, vergences, shape, like), build)

    def _optics_key(self, wavelengths: Tensor, vergences: Tensor, shape: tuple[int, int], like: Tensor) -> tuple:
        names = (self.propagator, self.method, self.pixel_pitch, self.fill_factor)
        return (fingerprint(self.lens), names, wavelengths, vergences, shape, str(like.dtype), str(like.device))

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
        shares = None if vergences.numel() == 1 else _layer_shares(depth, vergences).to(planes)
        if shares is not None:
            present = (shares.flatten(2).amax(dim=(0, 2)) > 0).cpu()
            vergences, shares = vergences[present], shares[:, present.to(shares.device)]
        window = self.psf_window(scene.wavelengths, vergences=vergences, picture=(height, width))
        # a bank of PSFs for as many layers as fit into a quarter of the memory
        per_layer = bands * window[0] * window[1] * planes.element_size()
        length = max(1, int(self.max_memory / 4 // per_layer))
        layers = _Layers(planes, shares)
        for start in range(0, vergences.numel(), length):
            psfs = self._psfs(scene.wavelengths, vergences[start : start + length], window, planes)
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
        self.picture = picture
        border_after = imaging.border != "zero"  # zeros may share their place with those before the picture
        self.size = tuple(
            fast_length(n + m - 1 if border_after else n + m // 2)
            for n, m in zip(picture, psfs.shape[-2:], strict=True)
        )

    def blur(self, planes: Tensor, *, layer: int) -> Tensor:
        """The scene's planes (B, K, H, W) through the PSFs of one layer: (B, C, H, W)."""
        spectrum = self._transform(planes)
        psfs = self.psfs[layer]
        if self.weights is None:
            return self._per_band(spectrum, psfs)
        if self.spectra is not None and self.weights.shape[0] * self.spectra.shape[0] <= psfs.shape[0]:
            kernels = torch.einsum("cl,kl,lyx->ckyx", self.weights, self.spectra, psfs)
            return self._back(self._apply_kernels(spectrum, kernels))
        return self._back(self._contract(spectrum, psfs, layer))

    def coverage(self, share: Tensor, *, layer: int) -> Tensor:
        """How a layer's mask (B, 1, H, W) spreads in each channel, relative to the PSFs' own sum: (B, C, H, W)."""
        psfs = self.psfs[layer]
        kernels = psfs if self.weights is None else torch.einsum("cl,lyx->cyx", self.weights, psfs)
        kernels = kernels / kernels.sum((-2, -1), keepdim=True)
        return self._back(self._transform(share) * self._transfer(kernels))

    def _transform(self, planes: Tensor) -> Tensor:
        return torch.fft.rfft2(_extend(planes, self.psfs.shape[-2:], self.imaging.border), s=self.size)

    def _transfer(self, kernels: Tensor) -> Tensor:
        """Conjugate transfer functions: the picture is upright, which turns the PSF by 180 degrees (a correlation)."""
        along_x = torch.fft.rfft(kernels, n=self.size[1])  # only the kernel's own rows, before the zero rows
        return torch.fft.fft(along_x, n=self.size[0], dim=-2).conj()

    def _back(self, spectrum: Tensor) -> Tensor:
        picture = torch.fft.irfft2(spectrum, s=self.size)
        return picture[..., : self.picture[0], : self.picture[1]]

    def _per_band(self, spectrum: Tensor, psfs: Tensor) -> Tensor:
        parts = []
        for part in self._parts(spectrum, psfs.shape[0]):
            bands = spectrum[:, part] if self.spectra is None else _mix(self.spectra[:, part].T, spectrum)
            parts.append(self._back(bands * self._transfer(psfs[part])))
        return torch.cat(parts, dim=1)

    def _apply_kernels(self, spectrum: Tensor, kernels: Tensor) -> Tensor:
        """sum_k T_ck C_k, one channel at a time."""
        return torch.stack([(spectrum * self._transfer(channel)).sum(1) for channel in kernels], dim=1)

    def _contract(self, spectrum: Tensor, psfs: Tensor, layer: int) -> Tensor:
        """sum_l kappa_cl H_l (sum_k S_kl C_k), split over the bands to stay within the memory."""
        parts = self._parts(spectrum, psfs.shape[0])
        transfers = self._kept_transfers(psfs, layer) if len(parts) == 1 else None

        def accumulate(spectrum: Tensor, psfs: Tensor, weights: Tensor, part: list[int]) -> Tensor:
            bands = spectrum[:, part] if self.spectra is None else _mix(self.spectra[:, part].T, spectrum)
            transfer = self._transfer(psfs[part]) if transfers is None else transfers
            return _mix(weights[:, part], bands * transfer)

        total = None
        for part in parts:
            arguments = (spectrum, psfs, self.weights, part)
            split = len(parts) > 1 and torch.is_grad_enabled()
            value = checkpoint(accumulate, *arguments, use_reentrant=False) if split else accumulate(*arguments)
            total = value if total is None else total + value
        return total

    def _kept_transfers(self, psfs: Tensor, layer: int) -> Tensor | None:
        """Transfer functions of all bands, kept between calls while the PSFs are the same and small enough."""
        size = psfs.shape[0] * self.size[0] * self.size[1] * psfs.element_size()
        if psfs.requires_grad or self.psfs.shape[0] > 1 or size > self.imaging.max_memory / 4:
            return None
        return self.imaging._transfer_cache.get((psfs, self.size), lambda: self._transfer(psfs))

    def _parts(self, spectrum: Tensor, bands: int) -> list[list[int]]:
        """Bands in groups whose transforms fit into max_memory."""
        plane = spectrum.shape[-2] * spectrum.shape[-1] * spectrum.element_size()
        per_band = plane * (3 * spectrum.shape[0] + 2)
        left = self.imaging.max_memory - plane * spectrum.shape[0] * spectrum.shape[1]
        length = max(1, min(bands, int(left // per_band)))
        return [list(range(start, min(start + length, bands))) for start in range(0, bands, length)]


def _mix(weights: Tensor, spectrum: Tensor) -> Tensor:
    """Real weights (C, L) on complex planes (B, L, ...): one real matrix product."""
    flat = torch.view_as_real(spectrum).flatten(2)
    mixed = torch.matmul(weights, flat)
    return torch.view_as_complex(mixed.view(spectrum.shape[0], weights.shape[0], *spectrum.shape[2:], 2))


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


def _layer_shares(depth: Tensor, vergences: Tensor) -> Tensor:
    """Share of each pixel in each layer, linear in vergence between neighbours: (B, Z, H, W), sums to 1."""
    position = (1 / depth - vergences[0].item()) / float(vergences[1] - vergences[0])
    layers = torch.arange(vergences.numel(), device=depth.device, dtype=torch.float64)
    return torch.clamp(1 - (position - layers[:, None, None]).abs(), min=0)


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

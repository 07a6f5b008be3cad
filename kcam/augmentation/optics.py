"""Wave optics: defocus, diffraction, aberrations and colour fringes by PSFs that are drawn per sample; vignetting."""

from __future__ import annotations

import math
import warnings
from typing import TypedDict, Unpack

import torch
from torch import Tensor
from torch.nn import functional as F

from kcam.augmentation.base import CameraAugmentation, check_inverse_depth, per_sample, wavelengths_of
from kcam.augmentation.distributions import Bounds, Draw, Normal, Uniform
from kcam.compiled import uncompiled
from kcam.optics import batch_psf, refractive_index, scattered_share, veiling_glare
from kcam.optics.rendering.convolution import Convolution
from kcam.optics.rendering.depth import Layers, layer_shares
from kcam.optics.rendering.renderer import Renderer
from kcam.units import check_length, check_pixel_pitch, mm, nm, um, wavelength_grid

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


class RandomDefocus(RandomBlur):
    """Defocus by wave optics: a thin lens focused at one distance, the picture at another, or at those of a depth map.

    W = V r^2 / 2,   V = 1 / distance - 1 / focus,   sensor at d = 1 / (1 / f - 1 / focus), aperture f / N

    With a map of inverse depth the picture is cut into `layers` layers, equally far apart in vergence, blurred and laid
    over each other from far to near, as `optics.Imaging` does. Such a map comes from `CameraSequential`, or as
    ``augment(image, inverse_depth=map)``, (B,1,H,W) or one number per sample (B,) [1/m], 0 at infinity.

    Args:      focus: distance in focus [m]. f_number: N > 0. distance: of the picture without a map [m]. Distances are
                   drawn uniformly in 1/m, inf allowed.
               focal_length: f [m]. pixel_pitch: [m]. By default a machine-vision camera, 8 mm with 4 um pixels.
               layers: of a depth map.
               Others: as for `kcam.augmentation.optics.RandomBlur`.
    Raises:    ValueError for bounds out of range, a focus inside the focal length; at the call for a map of another
        shape or below 0.
    Valid      where `batch_psf` is: paraxial, 1 % where a^4 / (8 d^3 lambda) is below 0.005 waves.

    Example:
    >>> point = torch.zeros(1, 3, 33, 33)
    >>> point[..., 16, 16] = 1.0
    >>> near, far = (KC.RandomDefocus(focus=2.0, distance=z, f_number=4.0, p=1.0)(point).amax() for z in (1.9, 0.5))
    >>> bool(near > far)  # what is farther out of focus is spread more
    True
    """

    takes_depth = True

    def __init__(
        self,
        focus: Bounds = (0.5, 5.0),
        f_number: Bounds = (1.8, 8.0),
        *,
        distance: Bounds = (0.5, 5.0),
        focal_length: Bounds = FOCAL_LENGTH,
        layers: int = 8,
        **options: Unpack[BlurOptions],
    ) -> None:
        draws: dict[str, Draw] = {
            "focus": Uniform(focus, "vergence", least=1e-3, unit="[m]"),
            "f_number": Uniform(f_number, "log", least=0.5, most=200.0),
            "distance": Uniform(distance, "vergence", least=1e-3, unit="[m]"),
            "focal_length": Uniform(focal_length, least=1e-4, most=10.0, unit="[m]"),
        }
        super().__init__(draws, **options)
        nearest, longest = self.bounds("focus")[0], self.bounds("focal_length")[1]
        if nearest <= longest:
            raise ValueError(
                f"focus {nearest:g} m is inside the focal length of {longest:g} m: no real image. Use "
                f"focus=({2 * longest:g}, ...) or a shorter focal_length."
            )
        if isinstance(layers, bool) or not isinstance(layers, int) or layers < 1:
            raise ValueError(f"layers must be a whole number of 1 or more, got {layers!r}.")
        self.layers = layers
        self.flags |= {"layers": layers}

    def widest(self, wavelengths: Tensor) -> float:
        """The blur of the widest aperture at the worst of the distances, or the diffraction of the narrowest."""
        low, high = (1 / bound for bound in self.bounds("distance"))
        shortest, longest = self.bounds("focal_length")
        near, far = (1 / bound for bound in self.bounds("focus"))
        most = max(abs(end - focus) for end in (low, high) for focus in (near, far))
        sensor_distance = 1 / (1 / longest - near)
        widths = []
        for number in self.bounds("f_number"):
            blur = longest / (2 * number) * most * sensor_distance
            radius = shortest / (2 * number)
            widths.append(blur + self.tail(radius=radius, sensor_distance=sensor_distance, wavelengths=wavelengths))
        return max(widths)

    def half_width(
        self, drawn: dict[str, Tensor], wavelengths: Tensor, between: tuple[float, float] | None = None
    ) -> float:
        """Rays and diffraction of this lens, for objects at its distance, or at two vergences and between [1/m]."""
        focal, focus, number, distance = (
            float(drawn[name].detach()) for name in ("focal_length", "focus", "f_number", "distance")
        )
        radius, sensor_distance = focal / (2 * number), 1 / (1 / focal - 1 / focus)
        most = max(abs(vergence - 1 / focus) for vergence in between or (1 / distance,))
        tail = self.tail(radius=radius, sensor_distance=sensor_distance, wavelengths=wavelengths)
        return radius * most * sensor_distance + tail

    def psfs(self, drawn: dict[str, Tensor], *, wavelengths: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
        """(B, 1, L, h, w), or (B, Z, L, h, w) for drawn["vergences"] (B, Z)."""
        focal, focus = drawn["focal_length"].double(), drawn["focus"].double()
        at = drawn["vergences"] if "vergences" in drawn else 1 / drawn["distance"].double()[:, None]
        return self.bank(
            at - 1 / focus[:, None].to(at.device),
            radii=focal / (2 * drawn["f_number"].double()),
            sensor_distance=1 / (1 / focal - 1 / focus),
            wavelengths=wavelengths,
            shape=shape,
            like=like,
        )

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """One depth at once; with a map sample by sample, layer by layer."""
        if "inverse_depth" not in drawn:
            return super().simulate(signal, drawn)
        depth = check_inverse_depth(drawn["inverse_depth"], signal).double()
        rows = []
        for index in range(len(signal)):
            row = slice(index, index + 1)
            own = {name: value[row] for name, value in drawn.items()} | {"inverse_depth": depth[row]}
            vergences, psfs = self.layered(signal[row], own)
            low, high = vergences[0], vergences[-1]
            shares = None if len(vergences) == 1 or low == high else layer_shares(depth[row], vergences).to(signal)
            layers = Layers(signal[row], shares)
            renderer = Renderer(psfs, spectra=None, weights=None, picture=(signal.shape[-2], signal.shape[-1]))
            layers.add(renderer, first=0)
            rows.append(layers.light)
        return torch.cat(rows)

    @uncompiled
    def layered(self, signal: Tensor, drawn: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """For one sample and its map: vergences of the layers (Z,) [1/m], and their PSFs (Z, L, h, w).

        The window is that of this map, which may reach beyond the range of distances.
        """
        low, high = drawn["inverse_depth"].aminmax()
        share = torch.linspace(0, 1, self.layers, dtype=low.dtype, device=low.device)
        vergences = low + (high - low) * (share if self.layers > 1 else share + 0.5)
        wavelengths = wavelengths_of(signal, self.wavelengths)
        half_width = self.half_width(drawn, wavelengths, (float(low.detach()), float(high.detach())))
        shape = self.window((signal.shape[-2], signal.shape[-1]), half_width)
        drawn = drawn | {"vergences": vergences[None]}
        return vergences, self.psfs(drawn, wavelengths=wavelengths, shape=shape, like=signal)[0]


LEAST_VERGENCE = 1e-9
"""1/m: where a distance is asked for, a map's 0 is a million kilometres."""


def finite_vergence(depth: Tensor, signal: Tensor) -> Tensor:
    """A map of inverse depth that a distance can be made of, float64; errors as `check_inverse_depth`."""
    return check_inverse_depth(depth, signal).double().clamp(min=LEAST_VERGENCE)


class FocusedBlur(RandomBlur):
    """Base of the augmentations by a lens that is in focus, at infinity, on its own wavefront error."""

    def __init__(
        self, draws: dict[str, Draw], *, f_number: Bounds, focal_length: float, **options: Unpack[BlurOptions]
    ) -> None:
        super().__init__(draws | {"f_number": Uniform(f_number, "log", least=0.5, most=200.0)}, **options)
        self.focal_length = check_length(
            focal_length, name="focal_length", within=FOCAL_LENGTH_RANGE, example=f"{FOCAL_LENGTH:g}"
        )
        self.flags |= {"focal_length": self.focal_length}

    def coefficients(self, drawn: dict[str, Tensor]) -> Tensor | None:
        """Noll's Zernikes (B, K) [m RMS], or None."""
        return None

    def vergences(self, drawn: dict[str, Tensor], wavelengths: Tensor) -> Tensor:
        """Residual vergence (B,) or (B, 1, L) [1/m]."""
        return torch.zeros_like(drawn["f_number"].double())

    def slope(self, wavelengths: Tensor, *, radius: float, drawn: dict[str, Tensor] | None = None) -> float:
        """Largest slope of the wavefront over the pupil, the angle of a ray [rad]: of a sample with these numbers, (1,)
        each; without, in the ranges.
        """
        return 0.0

    def widest(self, wavelengths: Tensor) -> float:
        """Diffraction and rays, at the ends of the range of f-numbers."""
        return max(self._width(number, wavelengths) for number in self.bounds("f_number"))

    def half_width(self, drawn: dict[str, Tensor], wavelengths: Tensor) -> float:
        """Diffraction and rays of this lens."""
        return self._width(float(drawn["f_number"].detach()), wavelengths, drawn)

    def _width(self, number: float, wavelengths: Tensor, drawn: dict[str, Tensor] | None = None) -> float:
        radius = self.focal_length / (2 * number)
        tail = self.tail(radius=radius, sensor_distance=self.focal_length, wavelengths=wavelengths)
        return tail + self.slope(wavelengths, radius=radius, drawn=drawn) * self.focal_length

    def psfs(self, drawn: dict[str, Tensor], *, wavelengths: Tensor, shape: tuple[int, int], like: Tensor) -> Tensor:
        """(B, 1, L, h, w)."""
        return self.bank(
            self.vergences(drawn, wavelengths),
            radii=self.focal_length / (2 * drawn["f_number"].double()),
            coefficients=self.coefficients(drawn),
            sensor_distance=self.focal_length,
            wavelengths=wavelengths,
            shape=shape,
            like=like,
        )


class RandomDiffraction(FocusedBlur):
    """A lens in focus and stopped down: Airy discs, larger in red than in blue.

    Args:      f_number: N, drawn uniformly in its logarithm. focal_length, pixel_pitch: [m].
               Others: as for `kcam.augmentation.optics.RandomBlur`.

    Example:
    >>> point = torch.zeros(1, 3, 33, 33)
    >>> point[..., 16, 16] = 1.0
    >>> red, green, blue = KC.RandomDiffraction(f_number=16.0, p=1.0)(point)[0, :, 16, 16]
    >>> bool(red < green < blue)  # the Airy disc of red is the largest
    True
    """

    def __init__(
        self, f_number: Bounds = (8.0, 32.0), *, focal_length: float = FOCAL_LENGTH, **options: Unpack[BlurOptions]
    ) -> None:
        super().__init__({}, f_number=f_number, focal_length=focal_length, **options)


class RandomAberration(FocusedBlur):
    """Random aberrations of a lens in focus: Zernike polynomials Z4 to Z15, of a drawn RMS in all.

    W = sum_j c_j Z_j,   sum_j c_j^2 = (rms 550 nm)^2,   in a direction that is uniform on the sphere

    Args:      rms: of the wavefront [waves at 550 nm], up to 5; 0.07 is what counts as diffraction limited.
               f_number, focal_length, pixel_pitch: of the lens. Others: as for `kcam.augmentation.optics.RandomBlur`.
               The time rises as the square of rms, and with the aperture: seconds for a picture at 5 waves and f/2.
    Source:    Noll, J. Opt. Soc. Am. 66, 207 (1976).

    Example:
    >>> picture = torch.full((1, 3, 32, 32), 0.5)  # even stays even
    >>> torch.allclose(KC.RandomAberration(rms=0.5, f_number=8.0, p=1.0)(picture), picture, atol=1e-3)
    True
    """

    TERMS = 12  # Z4 .. Z15: all but piston and tilts, up to the fourth order
    together = False

    def __init__(
        self,
        rms: Bounds = (0.0, 0.5),
        f_number: Bounds = (1.8, 8.0),
        *,
        focal_length: float = FOCAL_LENGTH,
        **options: Unpack[BlurOptions],
    ) -> None:
        super().__init__(
            {"rms": Uniform(rms, least=0.0, most=5.0, unit="[waves]"), "direction": Normal(self.TERMS)},
            f_number=f_number,
            focal_length=focal_length,
            **options,
        )

    def coefficients(self, drawn: dict[str, Tensor]) -> Tensor:
        """(B, 15) [m RMS]; the first three are 0."""
        direction = F.normalize(drawn["direction"].double(), dim=1)
        return F.pad(direction * drawn["rms"].double()[:, None].to(direction) * DESIGN, (3, 0))

    def slope(self, wavelengths: Tensor, *, radius: float, drawn: dict[str, Tensor] | None = None) -> float:
        """The steepest sum of Z4 to Z15 rises by 20 RMS / a at 0.8 a, the mean one by 15 at the rim.

        At 2 waves nine draws of ten then send less than 1.1 % of their light farther; the worst of 60 sent 2.4 %.
        """
        rms = self.bounds("rms")[1] if drawn is None else float(drawn["rms"].detach())
        return rms * DESIGN * 20 / radius


class RandomChromaticAberration(FocusedBlur):
    """Colour fringes of a lens whose glass disperses, as far as its designer left them.

    axial:   the lens is in focus at 550 nm; elsewhere its power is off by  axial (n(lambda) - n_0) / (n_0 - 1) / f
    lateral: the picture at lambda is (1 + lateral (n(lambda) - n_0) / (n_F - n_C)) times as large; n_F - n_C between
             486.1 and 656.3 nm

    Masks, boxes and keypoints stay: green does not move. Beyond the border the picture is reflected.

    Args:      axial: share of a simple lens's focal shift that is left; 1 is a singlet. lateral: difference of
                   magnification between F and C light, signed. f_number, focal_length, pixel_pitch: of the lens.
               glass: a name in `optics.GLASSES`. Others: as for `kcam.augmentation.optics.RandomBlur`.

    Example:
    >>> point = torch.zeros(1, 3, 33, 33)
    >>> point[..., 16, 16] = 1.0
    >>> red, green, blue = KC.RandomChromaticAberration(axial=0.3, lateral=0.0, f_number=4, p=1.0)(point)[0, :, 16, 16]
    >>> bool(green > red), bool(green > blue)  # red and blue are out of focus
    (True, True)
    """

    def __init__(
        self,
        axial: Bounds = (0.0, 0.3),
        lateral: Bounds = (-4e-3, 4e-3),
        f_number: Bounds = (1.8, 8.0),
        *,
        focal_length: float = FOCAL_LENGTH,
        glass: str = "N-BK7",
        **options: Unpack[BlurOptions],
    ) -> None:
        draws: dict[str, Draw] = {
            "axial": Uniform(axial, least=-10.0, most=10.0),
            "lateral": Uniform(lateral, least=-0.2, most=0.2),
        }
        super().__init__(draws, f_number=f_number, focal_length=focal_length, **options)
        self.glass = glass
        self.flags |= {"glass": glass}
        self.dispersion(wavelength_grid([DESIGN]))  # refuses an unknown glass

    def dispersion(self, wavelengths: Tensor) -> tuple[Tensor, Tensor]:
        """(n - n_0) / (n_0 - 1) and (n - n_0) / (n_F - n_C), (L,) each."""
        lines = torch.tensor([DESIGN, 486.1 * nm, 656.3 * nm], dtype=torch.float64)
        own = refractive_index(self.glass, wavelengths=wavelengths.double())
        centre, f_line, c_line = refractive_index(self.glass, wavelengths=lines)
        return (own - centre) / (centre - 1), (own - centre) / (f_line - c_line)

    def vergences(self, drawn: dict[str, Tensor], wavelengths: Tensor) -> Tensor:
        """More power focuses nearer: what is left is a vergence of the other sign."""
        power, _ = self.dispersion(wavelengths)
        axial = drawn["axial"].double()
        return -axial[:, None, None] * power.to(axial.device) / self.focal_length

    def slope(self, wavelengths: Tensor, *, radius: float, drawn: dict[str, Tensor] | None = None) -> float:
        """Of the focal shift at the ends of the spectrum."""
        power, _ = self.dispersion(wavelengths)
        shifts = self.bounds("axial") if drawn is None else drawn["axial"].tolist()
        return radius * max(map(abs, shifts)) * float(power.abs().max()) / self.focal_length

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Each channel at its size, then blurred."""
        _, relative = self.dispersion(wavelengths_of(signal, self.wavelengths))
        lateral = drawn["lateral"].double()
        scale = 1 + lateral[:, None] * relative.to(lateral.device)
        return super().simulate(magnify(signal, scale), drawn)


def magnify(signal: Tensor, scale: Tensor) -> Tensor:
    """Each channel (B,C,H,W) `scale` (B,C) times as large about the picture's centre; bilinear, reflected outside."""
    batch, channels, height, width = signal.shape
    side = [torch.arange(n, dtype=torch.float64, device=signal.device) * 2 + 1 for n in (height, width)]
    y, x = (position / n - 1 for position, n in zip(side, (height, width), strict=True))
    grid = torch.stack(torch.broadcast_tensors(x[None, :], y[:, None]), dim=-1)
    grid = (grid / scale.to(signal.device).flatten()[:, None, None, None]).to(signal)
    planes = signal.reshape(batch * channels, 1, height, width)
    moved = F.grid_sample(planes, grid, mode="bilinear", padding_mode="reflection", align_corners=False)
    return moved.view(signal.shape)


class RandomVeilingGlare(CameraAugmentation):
    """Light that the lens scatters over the picture, blue more than red: `optics.veiling_glare`.

    Args:      share: of the light that is scattered at 550 nm, 0 to 0.9: 0.01 of a clean prime, 0.1 of a fingerprint.
               core: shoulder of Harvey's law [direction cosine, about rad], drawn uniformly in its logarithm.
               slope: of its tail, 0.1 to 6.
               focal_length, pixel_pitch: [m]; by default a machine-vision camera, 8 mm with 4 um pixels.
               wavelengths: of the channels [m]; None: see `base`.
    Raises:    ValueError for bounds out of range, lengths that are not in metres, or too few wavelengths.

    Example:
    >>> picture = torch.ones(1, 3, 64, 64)
    >>> picture[..., 24:40, 24:40] = 0.0
    >>> hazy = KC.RandomVeilingGlare(share=0.1, core=0.003, slope=2.0, p=1.0)(picture)
    >>> bool(hazy[0, 2, 32, 32] > hazy[0, 0, 32, 32] > 0.2)  # the black of a white wall is a bluish gray
    True
    """

    alone = True

    def __init__(
        self,
        share: Bounds = (0.005, 0.08),
        core: Bounds = (0.002, 0.02),
        slope: Bounds = (1.6, 2.4),
        *,
        focal_length: float = FOCAL_LENGTH,
        pixel_pitch: float = PIXEL_PITCH,
        wavelengths: Tensor | list[float] | None = None,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        draws: dict[str, Draw] = {
            "share": Uniform(share, least=0.0, most=0.9),
            "core": Uniform(core, "log", least=1e-6, most=1.0, unit="[rad]"),
            "slope": Uniform(slope, least=0.1, most=6.0),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.focal_length = check_length(
            focal_length, name="focal_length", within=FOCAL_LENGTH_RANGE, example="50 * mm"
        )
        self.pixel_pitch = check_pixel_pitch(pixel_pitch)
        self.flags = {"focal_length": self.focal_length, "pixel_pitch": self.pixel_pitch}
        self.wavelengths = None if wavelengths is None else wavelength_grid(wavelengths)

    @uncompiled  # the compiler has no code for complex numbers
    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Row by row, each channel with a tail of its own."""
        wavelengths, reach = wavelengths_of(signal, self.wavelengths), self.focal_length / self.pixel_pitch
        rows = []
        for row, share, core, slope in zip(signal.split(1), drawn["share"], drawn["core"], drawn["slope"], strict=True):
            shares = scattered_share(share, wavelengths.to(share.device), reference=DESIGN)
            cores = core.double() * reach * (wavelengths.to(core.device) / DESIGN)
            rows.append(veiling_glare(row, share=shares, core=cores, slope=slope, reach=reach))
        return torch.cat(rows)


class RandomVignetting(CameraAugmentation):
    """Light falls off towards the corners: cos^4 of the field angle, and less of the pupil is seen from the side.

    E / E_0 = cos^4(theta) (1 - shade u^2),   tan(theta) = u tan(field / 2),   u the distance from the centre, 1 at the
    corners

    Args:      field: full angle between opposite corners [degrees]; 47 is a 50 mm lens on full frame, 75 a phone.
               shade: share of the pupil that the corner does not see.
    Warns:     UserWarning for a field of at most pi degrees, which darkens no corner: it was probably meant in radians.
    Source:    the cos^4 law: Born and Wolf, Principles of Optics, section 4.8.

    Example:
    >>> white = torch.ones(1, 3, 65, 65)
    >>> corner = float(KC.RandomVignetting(field=60.0, shade=0.0, p=1.0)(white)[0, 0, 0, 0])
    >>> round(((corner + 0.055) / 1.055) ** 2.4, 2), round(math.cos(math.radians(30)) ** 4, 2)  # its light
    (0.56, 0.56)
    """

    alone = True

    def __init__(
        self,
        field: Bounds = (20.0, 80.0),
        shade: Bounds = (0.0, 0.4),
        *,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        draws: dict[str, Draw] = {
            "field": Uniform(field, least=0.0, most=160.0, unit="[degrees]"),
            "shade": Uniform(shade, least=0.0, most=1.0),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        widest = float(torch.as_tensor(field).detach().max())
        if 0 < widest <= math.pi:
            darkened = 1 - math.cos(math.radians(widest) / 2) ** 4
            warnings.warn(
                f"a field of {widest:g} degrees darkens the corners by {darkened:.2%}. Angles are in degrees; did you "
                f"mean {math.degrees(widest):.3g}, which is {widest:g} rad?",
                stacklevel=2,
            )

    @staticmethod
    def falloff(shape: tuple[int, int], *, drawn: dict[str, Tensor], like: Tensor) -> Tensor:
        """(B,1,H,W), 1 at the centre."""
        height, width = shape
        y, x = (torch.arange(n, dtype=like.dtype, device=like.device) - (n - 1) / 2 for n in shape)
        corner = max(((height - 1) ** 2 + (width - 1) ** 2) / 4, 1e-12)
        u2 = (x[None, :] ** 2 + y[:, None] ** 2) / corner
        tangent = torch.tan(torch.deg2rad(per_sample(drawn["field"], like)) / 2)
        return (1 - per_sample(drawn["shade"], like) * u2) / (1 + tangent**2 * u2) ** 2

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """All channels alike."""
        return signal * self.falloff((signal.shape[-2], signal.shape[-1]), drawn=drawn, like=signal)

"""A lens in focus, and what is left of a point all the same: diffraction, its wavefront error, its colours."""

from __future__ import annotations

from typing import Unpack

import torch
from torch import Tensor
from torch.nn import functional as F

from kcam.augmentation.base import wavelengths_of
from kcam.augmentation.distributions import Bounds, Draw, Normal, Uniform
from kcam.augmentation.optics.blur import DESIGN, FOCAL_LENGTH, FOCAL_LENGTH_RANGE, BlurOptions, RandomBlur
from kcam.optics import refractive_index
from kcam.units import check_length, nm, wavelength_grid


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

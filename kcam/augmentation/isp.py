"""The image signal processor: white balance, colour matrix and tone, each a little wrong."""

from __future__ import annotations

import torch
from torch import Tensor

from kcam.augmentation.base import CameraAugmentation, wavelengths_of
from kcam.augmentation.distributions import Bounds, Draw, Normal, Uniform
from kcam.isp import apply_colour_matrix, render_tones
from kcam.isp.colour import CONTRASTS, GAMMAS
from kcam.units import nm, wavelength_grid

DAYLIGHT = 6504.0  # K, the correlated colour temperature of D65
_SECOND_RADIATION_CONSTANT = 1.438777e-2  # m K, h c / k
_REFERENCE = 550 * nm


def planck_ratio(wavelengths: Tensor, *, temperature: Tensor, of: float = DAYLIGHT) -> Tensor:
    """Light of a black body relative to that of another, 1 at 550 nm.

    r(lambda) = s(lambda) / s(550 nm),   s = (exp(c2 / (lambda T_of)) - 1) / (exp(c2 / (lambda T)) - 1)

    Args:      wavelengths: (L,) [m]. temperature: T, (B,) [K]. of: T_of [K].
    Returns:   (B,L) float64.
    Source:    Planck's law, c2 of CODATA 2018.
    """
    grid = torch.cat([wavelengths.to(temperature.device), wavelengths.new_tensor([_REFERENCE]).to(temperature.device)])
    old = torch.expm1(_SECOND_RADIATION_CONSTANT / (grid * of))
    new = torch.expm1(_SECOND_RADIATION_CONSTANT / (grid * temperature[:, None]))
    ratio = old / new
    return ratio[:, :-1] / ratio[:, -1:]


class RandomWhiteBalance(CameraAugmentation):
    """The light has another colour than the camera was balanced for.

    A cube is lit by a black body of the drawn temperature instead of daylight. A picture gets the gains that such light
    leaves unbalanced: those at the dominant wavelengths of its primaries. Green (550 nm) stays as it is.

    Args:      temperature: [K], uniform in its inverse, the mired; 6504 is daylight and changes nothing.
               tint: log2 of a gain in green alone, as magenta (below 0) and green casts of lamps. Pictures only.
               wavelengths: of the channels [m].

    Example:
    >>> gray = torch.full((1, 3, 4, 4), 0.5)
    >>> red, green, blue = KC.RandomWhiteBalance(temperature=3000.0, tint=0.0, p=1.0)(gray)[0, :, 0, 0]
    >>> bool(red > green > blue)  # the light of a lamp, balanced for daylight
    True
    """

    alone = True

    def __init__(
        self,
        temperature: Bounds = (4000.0, 10_000.0),
        tint: Bounds = (-0.1, 0.1),
        *,
        wavelengths: Tensor | None = None,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        draws: dict[str, Draw] = {
            "temperature": Uniform(temperature, "vergence", least=1000.0, most=1e5, unit="[K]"),
            "tint": Uniform(tint, least=-4.0, most=4.0, unit="[stops]"),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        self.wavelengths = None if wavelengths is None else wavelength_grid(wavelengths)

    def gains(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """(B,C), what each channel is multiplied by."""
        gains = planck_ratio(wavelengths_of(signal, self.wavelengths), temperature=drawn["temperature"].double())
        if signal.shape[-3] == 3:
            green = torch.tensor([0.0, 1.0, 0.0], dtype=gains.dtype, device=gains.device)
            gains = gains * 2 ** (drawn["tint"].to(gains)[:, None] * green)
        return gains

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """A gain for each channel of each row."""
        if signal.shape[1] == 1:
            return signal
        return signal * self.gains(signal, drawn).to(signal)[:, :, None, None]


class RandomColourMatrix(CameraAugmentation):
    """A colour matrix that was fitted badly: colours mix, white stays white.

    M = 1 + strength (G - diag(G 1)),   G 3 x 3 standard normal numbers:   M (1,1,1)^T = (1,1,1)^T

    Args:      strength: standard deviation of the matrix's elements.
    Raises:    ValueError at the call for anything but 3 channels.

    Example:
    >>> white = torch.ones(1, 3, 4, 4)
    >>> torch.allclose(KC.RandomColourMatrix(strength=0.1, p=1.0)(white), white, atol=1e-5)  # white stays
    True
    """

    def __init__(
        self, strength: Bounds = (0.0, 0.1), *, same_on_batch: bool = False, p: float = 0.5, keepdim: bool = False
    ) -> None:
        draws: dict[str, Draw] = {"strength": Uniform(strength, least=0.0), "mixing": Normal(9)}
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)

    @staticmethod
    def matrix(drawn: dict[str, Tensor]) -> Tensor:
        """(B,3,3) float64."""
        mixing = drawn["mixing"].double().unflatten(1, (3, 3))
        mixing = mixing - torch.diag_embed(mixing.sum(2))
        identity = torch.eye(3, dtype=torch.float64, device=mixing.device)
        return identity + drawn["strength"].to(mixing)[:, None, None] * mixing

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Each row with its own matrix."""
        if signal.shape[1] != 3:
            raise ValueError(
                f"RandomColourMatrix mixes red, green and blue, got {signal.shape[1]} channels. Put it after the "
                "RandomBayer or RandomCamera that makes a picture of a cube."
            )
        rows = zip(signal, self.matrix(drawn), strict=True)
        return torch.stack([apply_colour_matrix(row, matrix=matrix) for row, matrix in rows])


class RandomToneCurve(CameraAugmentation):
    """Another rendering of tones: a gamma, then an S-curve, on the coded picture (on cubes on the light itself).

    u = ((v + e)^gamma - e^gamma) / ((1 + e)^gamma - e^gamma),  e = 0.01;   y = u + 2 c u (1 - u) (2 u - 1)

    Both keep black at 0 and white at 1 and rise everywhere; e keeps the slope at black finite.

    Args:      gamma: drawn uniformly in its logarithm; above 1 darkens. contrast: c, -0.49 to 0.49.

    Example:
    >>> darker = KC.RandomToneCurve(gamma=2.0, contrast=0.0, p=1.0)(torch.full((1, 3, 4, 4), 0.5))
    >>> round(float(darker[0, 0, 0, 0]), 3)
    0.255
    """

    in_light = False
    alone = True

    def __init__(
        self,
        gamma: Bounds = (0.7, 1.4),
        contrast: Bounds = (-0.2, 0.3),
        *,
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        draws: dict[str, Draw] = {
            "gamma": Uniform(gamma, "log", least=GAMMAS[0], most=GAMMAS[1]),
            "contrast": Uniform(contrast, least=CONTRASTS[0], most=CONTRASTS[1]),
        }
        super().__init__(draws, same_on_batch=same_on_batch, p=p, keepdim=keepdim)

    def simulate(self, signal: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """Values are clipped to 0..1 first, outside of which the curve would turn; row by row, which stays in cache."""
        gammas, contrasts = (drawn[name].to(signal).unbind() for name in ("gamma", "contrast"))
        rows = zip(signal, gammas, contrasts, strict=True)
        return torch.stack([render_tones(row, gamma=gamma, contrast=contrast) for row, gamma, contrast in rows])

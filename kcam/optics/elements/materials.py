"""Refractive indices of optical glasses, crystals and polymers by their published Sellmeier equations.

All hold over the default bands, 420 to 720 nm, but PMMA and polycarbonate, which start at 436.8 nm, and ZnSe, at
540 nm: scenes for these need wavelengths of their own.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from kcam.cache import is_plain


@dataclass(frozen=True)
class Sellmeier:
    """Sellmeier coefficients: n^2 = 1 + sum_i B_i x^2 / (x^2 - C_i), x the wavelength in micrometres.

    b, c [um^2]; valid: range of the fit [um]; source: who published it.
    """

    b: tuple[float, float, float]
    c: tuple[float, float, float]
    valid: tuple[float, float]
    source: str

    def __post_init__(self) -> None:
        for name in ("b", "c", "valid"):  # lists, too, and then it is hashable
            object.__setattr__(self, name, tuple(getattr(self, name)))


D_F_C = (0.5875618, 0.4861327, 0.6562725)
"""Fraunhofer lines that nd and vd are of [um]."""


@dataclass(frozen=True)
class Glass:
    """A glass as a patent states it: n(lambda) = A + B / lambda^2, through n_d and with n_F - n_C = (n_d - 1) / v_d.

    nd: index at 587.56 nm, above 1. vd: Abbe number, above 0.
    Raises: ValueError for others. Valid in the visible, to some 1e-3 at its ends.

    Example:
    >>> glass = optics.Glass(nd=1.5168, vd=64.2)
    >>> index = optics.refractive_index(glass, wavelengths=torch.tensor([486.13, 587.56, 656.27]).double() * nm)
    >>> round(float((index[1] - 1) / (index[0] - index[2])), 1)
    64.2
    """

    nd: float
    vd: float

    def __post_init__(self) -> None:
        if not (1 < self.nd < 5 and self.vd > 0):
            raise ValueError(f"a glass has nd above 1 and vd above 0, got Glass(nd={self.nd:g}, vd={self.vd:g}).")

    def index(self, wavelengths: Tensor) -> Tensor:
        """Refractive index at wavelengths [m], float64."""
        d, f, c = (line * 1e-6 for line in D_F_C)
        b = (self.nd - 1) / self.vd / (1 / f**2 - 1 / c**2)
        return self.nd + b * (1 / wavelengths.to(torch.float64) ** 2 - 1 / d**2)


_SCHOTT = "SCHOTT Zemax catalogue 2017-01-20b, 20 C in air"
GLASSES = {
    "N-BK7": Sellmeier(
        (1.03961212, 0.231792344, 1.01046945),
        (0.00600069867, 0.0200179144, 103.560653),
        (0.3, 2.5),
        _SCHOTT,
    ),
    "N-K5": Sellmeier(
        (1.08511833, 0.199562005, 0.930511663),
        (0.00661099503, 0.024110866, 111.982777),
        (0.31, 2.5),
        _SCHOTT,
    ),
    "N-BAK4": Sellmeier(
        (1.28834642, 0.132817724, 0.945395373),
        (0.00779980626, 0.0315631177, 105.965875),
        (0.334, 2.5),
        _SCHOTT,
    ),
    "N-SK16": Sellmeier(
        (1.34317774, 0.241144399, 0.994317969),
        (0.00704687339, 0.0229005, 92.7508526),
        (0.31, 2.5),
        _SCHOTT,
    ),
    "N-LAK22": Sellmeier(
        (1.14229781, 0.535138441, 1.04088385),
        (0.00585778594, 0.0198546147, 100.834017),
        (0.31, 2.5),
        _SCHOTT,
    ),
    "N-FK51A": Sellmeier(
        (0.971247817, 0.216901417, 0.904651666),
        (0.00472301995, 0.0153575612, 168.68133),
        (0.29, 2.5),
        _SCHOTT,
    ),
    "F2": Sellmeier(
        (1.34533359, 0.209073176, 0.937357162),
        (0.00997743871, 0.0470450767, 111.886764),
        (0.32, 2.5),
        _SCHOTT,
    ),
    "N-F2": Sellmeier(
        (1.39757037, 0.159201403, 1.2686543),
        (0.00995906143, 0.0546931752, 119.248346),
        (0.365, 2.5),
        _SCHOTT,
    ),
    "N-SF5": Sellmeier(
        (1.52481889, 0.187085527, 1.42729015),
        (0.011254756, 0.0588995392, 129.141675),
        (0.37, 2.5),
        _SCHOTT,
    ),
    "N-SF6": Sellmeier(
        (1.77931763, 0.338149866, 2.08734474),
        (0.0133714182, 0.0617533621, 174.01759),
        (0.37, 2.5),
        _SCHOTT,
    ),
    "N-SF11": Sellmeier(
        (1.73759695, 0.313747346, 1.89878101),
        (0.013188707, 0.0623068142, 155.23629),
        (0.37, 2.5),
        _SCHOTT,
    ),
    "N-LASF9": Sellmeier(
        (2.00029547, 0.298926886, 1.80691843),
        (0.0121426017, 0.0538736236, 156.530829),
        (0.365, 2.5),
        _SCHOTT,
    ),
    "fused silica": Sellmeier(
        (0.6961663, 0.4079426, 0.8974794),
        (0.004679148258, 0.01351206307, 97.93400254),
        (0.21, 3.71),
        "Malitson, J. Opt. Soc. Am. 55, 1205 (1965), 20 C",
    ),
    "CaF2": Sellmeier(
        (0.5675888, 0.4710914, 3.8484723),
        (0.002526429988, 0.0100783328, 1200.555973),
        (0.23, 9.7),
        "Malitson, Appl. Opt. 2, 1103 (1963), 24 C",
    ),
    "BaF2": Sellmeier(
        (0.643356, 0.506762, 3.8261),
        (0.003339568521, 0.0120297024, 2151.698105),
        (0.2652, 10.346),
        "Malitson, J. Opt. Soc. Am. 54, 628 (1964), 25 C",
    ),
    "MgF2": Sellmeier(
        (0.48755108, 0.39875031, 2.3120353),
        (0.001882178397, 0.008951888472, 566.1355913),
        (0.2, 7.0),
        "Dodge, Appl. Opt. 23, 1980 (1984), ordinary ray, 19 C",
    ),
    "sapphire": Sellmeier(
        (1.4313493, 0.65054713, 5.3414021),
        (0.005279926102, 0.01423826471, 325.0178341),
        (0.2, 5.0),
        "Malitson & Dodge, J. Opt. Soc. Am. 62, 1405 (1972); Dodge, Handbook of Laser Science IV, 30 (1986), o, 20 C",
    ),
    "ZnSe": Sellmeier(
        (4.45813734, 0.467216334, 2.8956629),
        (0.04034468055, 0.1531713896, 2221.822369),
        (0.54, 18.2),
        "Connolly et al., Proc. SPIE 181, 141 (1979), fitted by Tatian, Appl. Opt. 23, 4477 (1984), 23 C",
    ),
    "PMMA": Sellmeier(
        (1.1819, 0.0, 0.0),
        (0.011313, 0.0, 0.0),
        (0.4368, 1.052),
        "Sultanova et al., Acta Phys. Pol. A 116, 585 (2009), 20 C; one-term fit by Polyanskiy",
    ),
    "polycarbonate": Sellmeier(
        (1.4182, 0.0, 0.0),
        (0.021304, 0.0, 0.0),
        (0.4368, 1.052),
        "Sultanova et al., Acta Phys. Pol. A 116, 585 (2009), 20 C; one-term fit by Polyanskiy",
    ),
}
"""Name -> dispersion: coefficients of its Sellmeier equation, the wavelengths [um] of the fit, and the source."""


def refractive_index(glass: str | float | Glass, *, wavelengths: Tensor | list[float]) -> Tensor:
    """Refractive index at each wavelength by the glass's Sellmeier equation, or a constant index.

    n^2 = 1 + sum_i B_i lambda^2 / (lambda^2 - C_i)

    Args:      glass: a name in `GLASSES`, a `Glass`, or a number > 1 for an index without dispersion; wavelengths: (L,)
               [m].
    Returns:   (L,) float64.
    Raises:    ValueError for an unknown glass, an index <= 1, or a wavelength outside the range of the fit: for PMMA,
               polycarbonate and ZnSe those of the default bands.
    Source:    cited for each glass in `GLASSES`; polymers are good to 1e-3, all others to 2e-5 at room temperature.

    Example:
    >>> round(float(optics.refractive_index("N-BK7", wavelengths=torch.tensor([587.56 * nm]))), 4)
    1.5168
    """
    wavelengths = torch.as_tensor(wavelengths)
    if isinstance(glass, Glass):
        return glass.index(wavelengths)
    if not isinstance(glass, str):
        if not float(glass) > 1:
            raise ValueError(f"refractive index {float(glass):g} must be > 1, or the name of a glass.")
        return torch.full_like(wavelengths, float(glass), dtype=torch.float64)
    if glass not in GLASSES:
        raise ValueError(f"unknown glass {glass!r}; known: {', '.join(sorted(GLASSES))}; or give a refractive index.")
    if not is_plain(wavelengths):
        return _sellmeier(glass, GLASSES[glass], wavelengths)
    found = _known_index(glass, GLASSES[glass], tuple(wavelengths.flatten().tolist()))
    return found.to(wavelengths.device, copy=True).view(wavelengths.shape)


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)
def _known_index(glass: str, entry: Sellmeier, wavelengths: tuple[float, ...]) -> Tensor:
    """Kept, because each part of a lens asks for it, again and again."""
    return _sellmeier(glass, entry, torch.tensor(wavelengths, dtype=torch.float64, device="cpu"))


def _sellmeier(glass: str, entry: Sellmeier, wavelengths: Tensor) -> Tensor:
    micrometres = wavelengths.to(torch.float64) * 1e6
    low, high = entry.valid
    outside = (micrometres < low) | (micrometres > high)
    if outside.any():
        first = 10 * (int(max(low * 1e3, 419)) // 10 + 1)  # of the default bands as many as there are, in round numbers
        raise ValueError(
            f"wavelength {float(micrometres[outside][0]) * 1e3:.6g} nm is outside the Sellmeier range of {glass}, "
            f"{low * 1e3:g}..{high * 1e3:g} nm ({entry.source}). Give the scene wavelengths within it, such as "
            f"torch.linspace({first}, 720, 28) * nm, or choose another glass or a constant index."
        )
    x2 = micrometres**2
    resonances = (b * x2 / (x2 - c) for b, c in zip(entry.b, entry.c, strict=True))
    return torch.sqrt(sum(resonances, torch.ones_like(x2)))

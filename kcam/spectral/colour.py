"""From spectra to colours: CIE XYZ, linear sRGB, and colours under another white."""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from kcam.spectral.bands import band_grid, read_table
from kcam.spectral.illuminants import illuminant, lamp_at_1nm
from kcam.spectral.measured import matching_integrals


def xyz_weights(wavelengths: Tensor, light: str | Tensor = "E") -> Tensor:
    """Weights that turn reflectances under a light into CIE XYZ: xyz = reflectances @ weights.

    W_lc = E_l * INT phi_l(lambda) xyzbar_c(lambda) d lambda / INT ybar d lambda,   phi_l: cubic through band l alone

    so a perfect white gets sum_l W_l, the light's white point with Y = 1. With the default, equal energy (E_l = 1), the
    weights apply to radiance.

    Args:      wavelengths: (L,) [m].  light: as in `illuminant`.
    Returns:   (L, 3) float64.
    Valid when the bands cover 420..680 nm in steps of some 15 nm. The 24 patches, against integration at 1 nm:
               delta-E2000 under D65 is 0.07 in the mean and 0.46 at most for the 28 default bands (they lack the ends
               of the spectrum), 0.01 and 0.03 for 400..700 nm in steps of 10 nm, 0.11 and 0.39 for 14 bands.
    Source:    Lagrange interpolation as in ASTM E2022, ends as in ASTM E308, but for bands at any distances.

    Example:
    >>> weights = spectral.xyz_weights(kcam.units.wavelength_grid(), "D65")
    >>> x, y, z = weights.sum(0)  # XYZ of a perfect white
    >>> round(float(x / (x + y + z)), 4), round(float(y / (x + y + z)), 4)  # D65: 0.3127, 0.3290
    (0.3127, 0.329)
    """
    return (
        torch.tensor(matching_integrals(band_grid(wavelengths))) * illuminant(light, wavelengths=wavelengths)[:, None]
    )


def spectrum_to_xyz(bands: Tensor, *, wavelengths: Tensor) -> Tensor:
    """The colour of relative radiance, in CIE XYZ where the perfect white under the scene's light has Y = 1.

    Args:      bands: (..., L, H, W) relative radiance.  wavelengths: (L,) [m].
    Returns:   (..., 3, H, W).
    Raises:    ValueError if L differs.

    Example:
    >>> wavelengths = kcam.units.wavelength_grid()
    >>> white = spectral.illuminant("D65", wavelengths=wavelengths)[:, None, None]
    >>> [round(float(value), 3) for value in spectral.spectrum_to_xyz(white, wavelengths=wavelengths).flatten()]
    [0.95, 1.0, 1.089]
    """
    weights = xyz_weights(wavelengths).to(bands)
    if bands.ndim < 3 or bands.shape[-3] != len(weights):
        raise ValueError(
            f"bands have shape {tuple(bands.shape)}, expected (..., {len(weights)}, H, W): one plane per wavelength."
        )
    return torch.einsum("...lhw,lc->...chw", bands, weights)


@functools.cache
def srgb_of_xyz() -> np.ndarray:
    """`xyz_to_srgb_matrix`, cached."""
    table, lamp = read_table("observer"), lamp_at_1nm("D65")
    white = table["values"].T @ lamp / (table["values"][:, 1] @ lamp)
    x, y = np.array([[0.64, 0.30, 0.15], [0.33, 0.60, 0.06]])
    primaries = np.stack([x / y, np.ones(3), (1 - x - y) / y])
    return np.linalg.inv(primaries * np.linalg.solve(primaries, white))


def xyz_to_srgb_matrix() -> Tensor:
    """The matrix from XYZ to linear sRGB, (3, 3) float64: its primaries, and its white at exactly our D65.

    Rounded matrices (IEC 61966-2-1, Kornia) differ by up to 4e-4 and tint a perfect white; this one gives 1, 1, 1.

    Example:
    >>> white = spectral.xyz_weights(kcam.units.wavelength_grid(), "D65").sum(0)
    >>> torch.allclose(spectral.xyz_to_srgb_matrix() @ white, torch.ones(3).double(), atol=1e-6)
    True
    """
    return torch.tensor(srgb_of_xyz())


def xyz_to_linear_srgb(xyz: Tensor) -> Tensor:
    """Linear sRGB from XYZ, (..., 3, H, W); not clipped, and not adapted to another white than D65.

    Example:
    >>> xyz = torch.tensor([0.4124, 0.2126, 0.0193])[:, None, None]  # the red primary
    >>> [round(float(value), 2) + 0.0 for value in spectral.xyz_to_linear_srgb(xyz).flatten()]
    [1.0, 0.0, 0.0]
    """
    return torch.einsum("rc,...chw->...rhw", xyz_to_srgb_matrix().to(xyz), xyz)


def adaptation(white: Tensor, target: Tensor) -> Tensor:
    """Bradford's matrix from colours under one white to those under another, XYZ to XYZ, (3, 3) float64.

    Args:      white, target: XYZ of the two whites, (3,).
    Source:    ICC.1:2022, annex E; as in the DNG specification.

    Example:
    >>> d50, d65 = torch.tensor([0.9642, 1.0, 0.8249]), torch.tensor([0.9505, 1.0, 1.089])
    >>> torch.allclose(spectral.adaptation(d50, d65) @ d50.double(), d65.double())
    True
    """
    rows = [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
    cones = torch.tensor(rows, dtype=torch.float64)
    change = (cones @ target.double()) / (cones @ white.double())
    return torch.linalg.inv(cones) @ (change[:, None] * cones)

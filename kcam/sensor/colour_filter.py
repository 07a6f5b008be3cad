"""Colour filters: sums of Gaussians, tables of measured curves, and the tile that learns.

kappa(lambda) = sum_i alpha_i N(lambda; mu_i, sigma),   i = 1..12                                     (thesis, eq. 3.9)

with centres mu_i equally spaced over 420..720 nm and one common sigma. Wavelengths are counted in units of that
spacing, Delta = 300 / 11 nm, so N = Delta / (sigma sqrt(2 pi)) exp(-(lambda - mu_i)^2 / 2 sigma^2): the twelve then add
up to about 1, and alpha_i is about the curve's own value near mu_i.

A table has triangles between its own wavelengths in their place, so that alpha are the measured values and a curve is
linear between them. A curve is a response per unit *energy* (irradiance, not photons), with the peak of green at 1;
a table of quantum efficiencies is per photon, and what it gives per energy is lambda / 550 nm times that.
"""

from __future__ import annotations

import copy
import functools
import math
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import scipy
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from kcam import spectral
from kcam.context import Context, Stage
from kcam.inputs import band_remedy, check_signal, table_remedy
from kcam.precision import full_precision
from kcam.sensor.arguments import hold
from kcam.sensor.mosaic import pattern_tile
from kcam.sensor.transmission import Transmission
from kcam.units import check_flag, check_trained, nm, wavelength_grid

BASIS_SIZE = 12
SPACING = 300 * nm / (BASIS_SIZE - 1)

REFERENCE_BANDWIDTH = 100 * nm
"""A filter of response 1 over this width turns an equal-energy white of 1 into a signal of 1."""

INFRARED_EDGE = 8 * nm
"""Scale of the infrared cut: its transmission falls from 90 to 10 % over 4.4 times this, 35 nm."""

PHOTON_WAVELENGTH = 550 * nm
"""Where a response per energy is the quantum efficiency itself."""

SHARPNESS = 10.0
"""Of the learned tile's softplus: alpha = softplus(10 x) / 10 is about x above 0.2, and its slope at 0.01 is 0.1."""

_REACH = math.exp(-2.0)
"""Of a Gaussian's peak: where it is less at every wavelength of a curve, the curve says nothing of it."""

LEAST_ALPHA = 0.01
"""What a learned tile starts from where the curve is 0."""


def gaussian_basis(wavelengths: Tensor, *, width: float = 18 * nm) -> Tensor:
    """The twelve Gaussians of eq. 3.9 at the given wavelengths, in units of their spacing.

    Args:      wavelengths: (L,) [m].  width: common standard deviation sigma [m].
    Returns:   (12, L) float64; for sigma from 13 nm they add up to 1 within 3 % between 455 and 685 nm.
    """
    centres = torch.linspace(420, 720, BASIS_SIZE, dtype=torch.float64, device=wavelengths.device) * nm
    distance = (wavelengths.double() - centres[:, None]) / width
    return SPACING / (width * math.sqrt(2 * math.pi)) * torch.exp(-0.5 * distance**2)


def infrared_transmission(wavelengths: Tensor, *, edge: Tensor | float) -> Tensor:
    """A smooth infrared cut filter: T = 1 / (1 + exp((lambda - edge) / 8 nm)), half transmission at `edge` [m]."""
    return torch.sigmoid((edge - wavelengths) / INFRARED_EDGE)


class GaussianFit(NamedTuple):
    """Curves as sums of Gaussians: coefficients (C,12) >= 0, the common width [m], and each curve's RMS error, as a
    share of green's peak.
    """

    coefficients: Tensor
    width: float
    errors: tuple[float, ...]


def fit_gaussians(curves: Tensor, *, wavelengths: Tensor) -> GaussianFit:
    """Write curves as non-negative sums of the twelve Gaussians, with the common width that suits them best.

    minimise over sigma = 13..30 nm and alpha >= 0:   sum over channels and wavelengths of (kappa - curve)^2

    Args:      curves: (C, L), in any scale.  wavelengths: (L,), equally spaced [m].
    Returns:   coefficients in float64, scaled so that green (channel 1, or the only one) peaks at exactly 1. What they
               are held to are the curves over their own green's peak, so a factor in the curves changes nothing. Of a
               Gaussian farther than two widths from all wavelengths nothing is known: its coefficient is 0.
    Raises:    ValueError for wavelengths out of range, curves of another shape or not finite, and a green that is 0,
               or that the Gaussians, centred between 420 and 720 nm, do not reach.
    Source:    Lawson and Hanson, Solving Least Squares Problems (1974), chapter 23: NNLS, as in scipy.

    Example:
    >>> wavelengths = torch.arange(400, 741, 10).double() * nm
    >>> fit = sensor.fit_gaussians(spectral.sensitivity("kodak", wavelengths=wavelengths), wavelengths=wavelengths)
    >>> fit.coefficients.shape, max(fit.errors) < 0.02
    (torch.Size([3, 12]), True)
    """
    grid = wavelength_grid(wavelengths)
    if not isinstance(curves, Tensor) or curves.ndim != 2 or curves.shape[1] != len(grid) or not len(curves):
        got = tuple(curves.shape) if isinstance(curves, Tensor) else type(curves).__name__
        raise ValueError(f"curves must be a tensor (C, {len(grid)}), one value per wavelength, got {got}.")
    given, green = curves.detach().double().cpu(), min(1, len(curves) - 1)
    peak = float(given[green].max())
    if not (given.isfinite().all() and peak > 0):
        raise ValueError(f"curves must be finite, and green's peak (channel {green}) above 0; it is {peak:g}.")
    given = given / peak
    if gaussian_basis(grid, width=30 * nm)[:, given[green].argmax()].sum() < 0.01:
        at = float(grid[given[green].argmax()]) / nm
        raise ValueError(f"green (channel {green}) peaks at {at:.0f} nm; the Gaussians, at 420 to 720 nm, end before.")

    def fit(width: float) -> GaussianFit:
        basis = gaussian_basis(grid, width=width)
        alpha = torch.zeros(len(given), BASIS_SIZE, dtype=torch.float64)
        reached = basis.amax(1) >= _REACH * basis.max()
        for row, curve in zip(alpha, given.numpy(), strict=True):
            row[reached] = torch.from_numpy(scipy.optimize.nnls(basis[reached].T.numpy(), curve)[0])
        alpha = alpha / (alpha @ basis)[green].max()
        return GaussianFit(alpha, width, tuple((alpha @ basis - given).square().mean(1).sqrt().tolist()))

    return min((fit(width * nm) for width in range(13, 31)), key=lambda result: math.hypot(*result.errors))


@functools.cache
def fitted(name: str) -> GaussianFit:
    """The fit to a named curve of `spectral.sensitivity`, over 400..740 nm in steps of 1 nm."""
    grid = torch.arange(400, 741, dtype=torch.float64) * nm
    return fit_gaussians(spectral.sensitivity(name, wavelengths=grid), wavelengths=grid)


class ColourFilter(Stage):
    """The spectral response of the sensor's pixels: bands to colour channels.

    channel_c = sum_l kappa_c(lambda_l) (width_l / 100 nm) bands_l

    with the bands' widths from `spectral.band_widths` and a constant reference of 100 nm, so that scaling the
    coefficients scales the signal. Two forms, by the shape of the coefficients:

    - curves (C,12): C = 3 for red, green, blue, 4 with white, 1 for a monochrome sensor; (B,L,H,W) to (B,C,H,W).
    - a tile (t,t,12): one curve per pixel, repeated over the sensor from its top left corner (eq. 3.9); (B,L,H,W) to
      the mosaiced plane (B,1,H,W). No Mosaic follows it.

    Of curves that are measured (`from_curves`, `from_csv`), alpha are their values at `nodes`, (C,N).

    Args:      coefficients: alpha >= 0, or with `softplus` unconstrained values x with alpha = softplus(10 x) / 10.
                   An nn.Parameter trains; without `softplus` nothing but the start keeps it from going negative.
               softplus: whether the coefficients pass through the softplus, so that alpha > 0 whatever is learnt.
               width: common standard deviation sigma of the Gaussians [m].
               nodes: wavelengths (N,) of a table, rising [m], instead of Gaussians.
               photons: whether alpha are electrons per photon: a response per energy is lambda / 550 nm times that.
               transmissions: what stands before the sensor, such as an infrared cut: see `behind`.
               infrared_cut: wavelength of half transmission of an infrared cut filter [m], see
                   `infrared_transmission`; None for no cut beyond what the curves themselves hold.
    Raises:    ValueError for coefficients of another shape, negative or not finite, or a length out of range;
               TypeError for coefficients that are no floating-point tensor.

    Example:
    >>> wavelengths = kcam.units.wavelength_grid(count=31)  # 420 to 720 nm in steps of 10 nm
    >>> response = sensor.ColourFilter.nikon().response(wavelengths)
    >>> [round(float(wavelengths[band] / nm)) for band in response.argmax(1)]  # peaks of red, green, blue
    [610, 530, 460]
    """

    coefficients: Tensor
    softplus: bool
    width: float
    nodes: Tensor | None
    photons: bool
    infrared_cut: Tensor | float | None

    def __init__(
        self,
        coefficients: Tensor,
        *,
        softplus: bool = False,
        width: float = 18 * nm,
        nodes: Tensor | None = None,
        photons: bool = False,
        infrared_cut: Tensor | float | None = None,
        transmissions: Sequence[Transmission] = (),
    ):
        super().__init__()
        if not (isinstance(coefficients, Tensor) and coefficients.is_floating_point()):
            raise TypeError(f"coefficients must be a floating-point tensor, got {_describe(coefficients)}.")
        nodes = None if nodes is None else spectral.rising(nodes)
        size, what = (BASIS_SIZE, "Gaussian") if nodes is None else (len(nodes), "wavelength of the table")
        if coefficients.ndim not in (2, 3) or coefficients.shape[-1] != size or coefficients.numel() == 0:
            raise ValueError(
                f"coefficients must be curves (C, {size}) or a tile (t, t, {size}), one value per "
                f"{what}, got shape {tuple(coefficients.shape)}."
            )
        if not coefficients.isfinite().all() or (not softplus and (coefficients < 0).any()):
            raise ValueError(
                f"coefficients must be finite{'' if softplus else ' and >= 0'}: light is absorbed, never negative. "
                + (
                    f"Got values from {coefficients.min().item():g} to {coefficients.max().item():g}; "
                    "clamp them, or pass softplus=True for unconstrained ones."
                    if coefficients.isfinite().all()
                    else f"{int((~coefficients.isfinite()).sum())} are NaN or infinite: give what was measured there."
                )
            )
        if not 1 * nm <= width <= 1000 * nm:
            raise ValueError(
                f"width {width:g} is outside 1e-9..1e-6 m. Widths are in metres; did you mean {width:g} * nm?"
            )
        if infrared_cut is not None:
            wavelength_grid(torch.as_tensor(infrared_cut))
        hold(self, coefficients=coefficients, softplus=softplus, width=width, infrared_cut=infrared_cut)
        self.nodes, self.photons = nodes, photons  # no buffer: half precision has no number so small
        self.transmissions: Any = nn.ModuleList(transmissions) if len(transmissions) else ()

    @classmethod
    def from_curves(
        cls, wavelengths: Tensor, curves: Tensor, *, quantum_efficiency: bool = False, trainable: bool = False
    ) -> ColourFilter:
        """Measured curves, interpolated as they are: linear between their wavelengths, and 0 outside of them.

        Args:      wavelengths: (L,) at any distances, rising or falling [m].
                   curves: (C, L) >= 0, any number of channels: relative, per unit of energy; or electrons per photon.
                   quantum_efficiency: whether they are electrons per photon, 0..1. `Exposure(time=...)` then counts
                       with them as they are. trainable: see `trainable`.
        Raises:    ValueError for wavelengths out of range or that do not rise, curves of another shape, negative or not
                   finite, above 2, or above 1 electron per photon (percent?); TypeError for what is no tensor.
        Valid when the bands of a scene are about as close as the table has structure: each stands for the curve's value
                   at its own wavelength. Light outside of the table is not seen.

        Example:
        >>> wavelengths = torch.tensor([400.0, 500.0, 600.0, 1000.0]) * nm
        >>> silicon = sensor.ColourFilter.from_curves(wavelengths, torch.tensor([[0.3, 0.6, 0.6, 0.1]]))
        >>> silicon.response(torch.tensor([450.0, 800.0, 1100.0]) * nm)  # half-way, half-way, and outside
        tensor([[0.4500, 0.3500, 0.0000]], dtype=torch.float64)
        """
        check_flag(quantum_efficiency, name="quantum_efficiency")
        nodes = spectral.rising(wavelengths, either_way=True)
        if not isinstance(curves, Tensor) or curves.ndim != 2 or curves.shape[1] != len(nodes) or not len(curves):
            got = tuple(curves.shape) if isinstance(curves, Tensor) else _describe(curves)
            raise ValueError(f"curves must be a tensor (C, {len(nodes)}), one value per wavelength, got {got}.")
        values = curves.detach().double().cpu()
        most, unit = (1.0, " electrons per photon") if quantum_efficiency else (2.0, "")
        if not values.isfinite().all() or (values < 0).any() or (values > most).any():
            raise ValueError(
                f"curves must be finite, >= 0 and at most {most:g}{unit}, "
                f"{table_remedy(values, name='curves', most=most)}"
            )
        if not values.any():
            raise ValueError("curves are all 0: this sensor sees nothing. Give its responses, such as 0.5 at 550 nm.")
        if float(wavelengths[0]) > float(wavelengths[-1]):
            values = values.flip(1)
        made = cls(values.float(), nodes=nodes, photons=quantum_efficiency)
        return made.trainable() if trainable else made

    @classmethod
    def from_csv(
        cls,
        path: str | os.PathLike[str],
        *,
        quantum_efficiency: bool = False,
        percent: bool = False,
        trainable: bool = False,
    ) -> ColourFilter:
        r"""Curves from a table: a header line, the first column in nanometres, then a column for each channel.

        Args:      as of `from_curves`, and `spectral.read_csv`.
        Raises:    as they do; errors name the line.

        Example:
        >>> from pathlib import Path
        >>> written = Path("qe.csv").write_text("nm, red, green, blue\n400, 0, 0.1, 0.4\n700, 0.5, 0, 0\n")
        >>> sensor.ColourFilter.from_csv("qe.csv", quantum_efficiency=True).coefficients.shape
        torch.Size([3, 2])
        """
        table = spectral.read_csv(path, percent=percent)
        try:
            return cls.from_curves(
                table.wavelengths, table.values, quantum_efficiency=quantum_efficiency, trainable=trainable
            )
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @classmethod
    def kodak(cls, *, infrared_cut: float | None = None) -> ColourFilter:
        """Red, green and blue of a Kodak colour sensor, after a smooth approximation (see `spectral.sensitivity`).

        The fit errs by 1.5, 0.5 and 0.4 % RMS of green's peak. The curves hold no infrared cut: a camera that is to
        see as the eye does adds one, such as ``infrared_cut=650 * nm``.
        """
        return cls._fitted("kodak", infrared_cut)

    @classmethod
    def nikon(cls, *, infrared_cut: float | None = None) -> ColourFilter:
        """The measured Nikon 5100, its infrared cut included.

        Its steep edges are beyond twelve Gaussians: the fit errs by 6.8, 1.6 and 4.9 % RMS, by 25 % at the red edge.
        """
        return cls._fitted("nikon_5100", infrared_cut)

    @classmethod
    def sigma(cls, *, infrared_cut: float | None = None) -> ColourFilter:
        """The measured Sigma SD Merrill, whose three broad curves come from stacked photodiodes, with its infrared cut.

        The fit errs by 3.7, 3.0 and 2.4 % RMS, by 24 % at the edge of the cut.
        """
        return cls._fitted("sigma_sd_merrill", infrared_cut)

    @classmethod
    def rgbw(cls, *, infrared_cut: float | None = None) -> ColourFilter:
        """The Kodak curves and a clear fourth one, for Mosaic("rgbw").

        White is an approximation, not a measurement: 1.2 times a Gaussian around 570 nm of sigma 140 nm, the shape of
        bare silicon per unit energy, above the three coloured curves. Under daylight a white pixel fills 2.9 times as
        fast as a green one, so expose for it: ``Exposure(0.27)`` brings a perfect white to 0.8 of its well.
        """
        fit = fitted("kodak")
        centres = torch.linspace(420, 720, BASIS_SIZE, dtype=torch.float64)
        clear = 1.2 * torch.exp(-0.5 * ((centres - 570) / 140) ** 2)
        coefficients = torch.cat([fit.coefficients, clear[None]])
        return cls(coefficients.float(), width=fit.width, infrared_cut=infrared_cut)

    @classmethod
    def learned(cls, tile: int = 28, *, infrared_cut: float | None = None) -> ColourFilter:
        """The trainable tile of eq. 3.9, non-negative by softplus, which starts as the Kodak curves in RGGB order.

        Args:      tile: side of the tile, >= 1 [pixels]; an even one continues the RGGB pattern without a seam.
        Raises:    TypeError or ValueError for a side that is no integer >= 1.
        """
        if isinstance(tile, bool) or not isinstance(tile, int):
            raise TypeError(f"tile must be a whole number of pixels such as 28, got {tile!r}.")
        if tile < 1:
            raise ValueError(f"tile must be >= 1 pixel, got {tile}.")
        fit = fitted("kodak")
        index = torch.arange(tile) % 2
        alpha = fit.coefficients[pattern_tile("RGGB")[index[:, None], index]]
        return cls(alpha.float(), width=fit.width, infrared_cut=infrared_cut).trainable()

    @property
    def bare(self) -> ColourFilter:
        """The same filter without what stands before it: it shares its coefficients."""
        made = copy.copy(self)
        made._modules = {}
        made.transmissions = ()
        return made

    def trainable(self) -> ColourFilter:
        """A filter of these curves to train, non-negative by softplus whatever it learns.

        Coefficients below 0.01 start there: at 0 the softplus has no inverse, and near it no slope to learn by.
        """
        alpha = self.alpha().detach().double().clamp(min=LEAST_ALPHA)
        raw = alpha + torch.log(-torch.expm1(-SHARPNESS * alpha)) / SHARPNESS
        names = ("width", "nodes", "photons", "infrared_cut", "transmissions")
        kept = {name: getattr(self, name) for name in names}
        return ColourFilter(nn.Parameter(raw.float()), softplus=True, **kept)

    def behind(self, *transmissions: Transmission) -> ColourFilter:
        """The same filter behind glasses, cuts and other transmissions: it shares its coefficients.

        A `Camera` does so by itself with those that stand before its filter.
        """
        made = copy.copy(self)
        made.__dict__.pop("transmissions", None)
        made._modules = {"transmissions": nn.ModuleList([*self.transmissions, *transmissions])}
        return made

    @classmethod
    def _fitted(cls, name: str, infrared_cut: float | None) -> ColourFilter:
        fit = fitted(name)
        return cls(fit.coefficients.float(), width=fit.width, infrared_cut=infrared_cut)

    @property
    def is_tile(self) -> bool:
        """Whether each pixel of a tile has its own curve, so that `forward` gives the mosaiced plane."""
        return self.coefficients.ndim == 3

    def alpha(self) -> Tensor:
        """The weights of the Gaussians, (C,12) or (t,t,12), or of a table its values, (C,N), >= 0.

        Raises:    ValueError for coefficients that were trained or loaded into NaN.
        """
        check_trained(self.coefficients, name="coefficients of the colour filter")
        return F.softplus(self.coefficients, beta=SHARPNESS) if self.softplus else self.coefficients

    def basis(self, wavelengths: Tensor) -> Tensor:
        """The Gaussians, or the triangles of a table, behind the infrared cut and all else before them, (12,L) or
        (N,L) float64.
        """
        grid = wavelength_grid(wavelengths).to(self.coefficients.device)
        if self.nodes is None:
            basis = gaussian_basis(grid, width=self.width)
        else:
            basis = spectral.interpolation(self.nodes, grid)
        if self.photons:
            basis = basis * (grid / PHOTON_WAVELENGTH)
        for transmission in self.transmissions:
            basis = basis * transmission.transmission(grid)
        if self.infrared_cut is not None:
            check_trained(torch.as_tensor(self.infrared_cut), name="infrared_cut of the colour filter")
            basis = basis * infrared_transmission(grid, edge=self.infrared_cut)
        return basis

    def response(self, wavelengths: Tensor) -> Tensor:
        """The curves kappa, per unit energy, (C,L) float64; of a tile the mean curve over its pixels, (1,L)."""
        alpha = self.alpha().double()
        return (alpha.mean((0, 1))[None] if self.is_tile else alpha) @ self.basis(wavelengths)

    def white(self, wavelengths: Tensor, *, illuminant: Tensor | None = None) -> Tensor:
        """The channels of a perfect white, (C,) float64: of the curves, or of the tile's mean curve, (1,).

        Args:      wavelengths: (L,) [m].  illuminant: (L,) relative spectral power; None for D65.
        Raises:    ValueError if their lengths differ.
        """
        if illuminant is None:
            illuminant = spectral.illuminant("D65", wavelengths=wavelengths)
        _check_bands(len(illuminant), wavelengths, "the illuminant has")
        response = self.response(wavelengths)
        return response @ (illuminant.double().cpu() * _shares(wavelengths)).to(response.device)

    @property
    def planes(self) -> int:
        """How many planes the contraction gives: one for each curve, or for each Gaussian of a tile."""
        return self.coefficients.shape[-1 if self.is_tile else 0]

    def contraction(self, wavelengths: Tensor) -> Tensor:
        """The weights over the bands, widths included: what an Imaging stage absorbs.

        forward(bands) = finish(sum_l contraction[k, l] bands[:, l])

        Returns:   (K,L) float64, K = `planes`; the coefficients of a tile are applied by `finish`.
        """
        basis = self.basis(wavelengths) * _shares(wavelengths).to(self.coefficients.device)
        return basis if self.is_tile else self.alpha().double() @ basis

    def finish(self, planes: Tensor) -> Tensor:
        """What is left to do after the contraction: nothing for curves; for a tile each pixel's sum of its Gaussians.

        Args:      planes: (..., K, H, W), K as in `contraction`; any H and W.
        Returns:   (..., C, H, W), for a tile (..., 1, H, W).
        Raises:    ValueError for another number of planes.
        """
        alpha = self.alpha()
        if planes.ndim < 3 or planes.shape[-3] != self.planes:
            raise ValueError(
                f"finish expects the {self.planes} planes of the contraction, (..., {self.planes}, H, W), "
                f"got shape {tuple(planes.shape)}."
            )
        if not self.is_tile:
            return planes
        height, width = planes.shape[-2:]
        rows, columns, _ = alpha.shape
        across = alpha.to(planes).permute(2, 0, 1).repeat(1, 1, -(-width // columns))[..., :width]  # (K, rows, W)
        whole, last = planes.split([height - height % rows, height % rows], dim=-2)  # of rows of tiles
        parts = [_sums(whole.unflatten(-2, (-1, rows)), across)] if whole.shape[-2] or not height else []
        parts += [_sums(last[..., None, :, :], across[:, : last.shape[-2]])] if last.shape[-2] else []
        found = [part.flatten(-3, -2) for part in parts]
        return (torch.cat(found, dim=-2) if len(found) > 1 else found[0]).unsqueeze(-3)

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """Bands (B,L,H,W) at the context's wavelengths to channels (B,C,H,W), or to the tile's plane (B,1,H,W).

        Raises:    ValueError if the number of bands is not that of the wavelengths.
        """
        wavelengths = (context or Context()).wavelengths
        check_signal(signal, bands=len(wavelengths))
        fix = ""
        if signal.ndim < 3 or signal.shape[-3] != len(wavelengths):
            fix = band_remedy(signal, name="signal", bands=len(wavelengths), ndims=(3, 4))
        if signal.ndim < 3:
            raise ValueError(f"expected bands (..., L, H, W), got shape {tuple(signal.shape)}.{fix}")
        _check_bands(signal.shape[-3], wavelengths, "the signal has", fix)
        weights = self.contraction(wavelengths).to(signal)
        with full_precision(signal.device):
            return self.finish(torch.einsum("kl,...lhw->...khw", weights, signal))

    def output_channels(self, channels: int, context: Context | None = None) -> int:
        """Its curves, or the one plane of a tile."""
        return 1 if self.is_tile else self.coefficients.shape[0]

    def provides(self) -> dict[str, ColourFilter]:
        """Itself, for exposure, white balance and colour matrix."""
        return {"colour_filter": self}

    def extra_repr(self) -> str:
        """The shape of the coefficients, what they are of, and the cut."""
        cut = "" if self.infrared_cut is None else f", infrared_cut={torch.as_tensor(self.infrared_cut).item():g}"
        of = f", width={self.width:g}"
        if self.nodes is not None:
            first, last = (float(end) / nm for end in self.nodes[[0, -1]])
            of = f", {first:.0f}..{last:.0f} nm{', photons=True' if self.photons else ''}"
        return f"{tuple(self.coefficients.shape)}, softplus={self.softplus}{of}{cut}"


def _sums(planes: Tensor, weights: Tensor) -> Tensor:
    """Of planes (..., K, Y, R, W) with weights (K, R, W), one plane after the other, (..., Y, R, W): a product of all
    would be as large as they are. In float32 at least.
    """
    wide = torch.promote_types(planes.dtype, torch.float32)
    first, *others = zip(planes.unbind(-4), weights.to(wide), strict=True)

    def add(total: Tensor, pair: tuple[Tensor, Tensor]) -> Tensor:
        return torch.addcmul(total, pair[0].to(wide), pair[1])

    return functools.reduce(add, others, first[0].to(wide) * first[1]).to(planes.dtype)


def _shares(wavelengths: Tensor) -> Tensor:
    return spectral.band_widths(wavelengths) / REFERENCE_BANDWIDTH


def _check_bands(bands: int, wavelengths: Tensor, subject: str, fix: str = "") -> None:
    if bands != len(wavelengths):
        raise ValueError(
            f"{subject} {bands} bands, but there are {len(wavelengths)} wavelengths; pass one wavelength per band, "
            f"such as Context(wavelengths=torch.linspace(420, 720, {bands}) * nm).{fix}"
        )


def _describe(value: object) -> str:
    return f"a tensor of {value.dtype}" if isinstance(value, Tensor) else type(value).__name__

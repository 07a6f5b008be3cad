"""Glass before the sensor: an infrared cut, a coloured filter, a lens's own absorption.

bands_l -> T(lambda_l) bands_l
"""

from __future__ import annotations

import os

from torch import Tensor

from kcam import spectral
from kcam.context import Context, Stage
from kcam.inputs import check_signal, table_remedy
from kcam.sensor.arguments import hold
from kcam.units import check_trained


class Transmission(Stage):
    """What a glass lets through, band by band: (B,L,H,W) to the same shape, before the `ColourFilter`.

    A camera knows of it: exposure, white balance and colour matrix see the filter behind it, and an Imaging takes both
    into its own computation.

    Args:      wavelengths: (N,) of the table, rising [m], at least two; or a table of one column, such as
                   `spectral.read_csv` gives.
               values: (N,) shares of the light, 0..1, linear between the wavelengths and constant beyond their ends. An
                   nn.Parameter trains.
    Raises:    ValueError for wavelengths out of range or that do not rise, values of another shape, not finite, or
               outside 0..1 (percent?), or a table of several columns; TypeError for what is no tensor.
    Source:    ASTM E308, for values beyond the ends of a table.

    Example:
    >>> infrared_cut = sensor.Transmission(torch.tensor([640.0, 680.0]).double() * nm, torch.tensor([1.0, 0.0]))
    >>> infrared_cut.transmission(torch.tensor([550.0, 660.0, 720.0]).double() * nm).tolist()
    [1.0, 0.5, 0.0]
    """

    wavelengths: Tensor
    values: Tensor

    def __init__(self, wavelengths: Tensor | spectral.SpectralTable, values: Tensor | None = None):
        super().__init__()
        if isinstance(wavelengths, spectral.SpectralTable):
            if len(wavelengths.values) != 1:
                names = ", ".join(wavelengths.names)
                raise ValueError(
                    f"the table has {len(wavelengths.values)} columns ({names}): expected one transmission."
                )
            values, wavelengths = wavelengths.values[0], wavelengths.wavelengths
        nodes = spectral.rising(wavelengths)
        if not isinstance(values, Tensor) or values.shape != nodes.shape:
            got = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
            raise ValueError(f"values must be a tensor ({len(nodes)},), one share per wavelength, got {got}.")
        shares = values.detach()
        if not ((shares >= 0) & (shares <= 1)).all():
            raise ValueError(f"values must be shares, 0..1, {table_remedy(shares, name='values', most=1.0)}")
        hold(self, values=values)
        self.wavelengths = nodes  # no buffer: half precision has no number so small

    @classmethod
    def from_csv(cls, path: str | os.PathLike[str], *, percent: bool = False) -> Transmission:
        r"""From a table of one column behind the nanometres: see `spectral.read_csv`, and its errors.

        Raises:    ValueError for a table of several columns.

        Example:
        >>> from pathlib import Path
        >>> written = Path("glass.csv").write_text("nm, T [%]\n400, 0\n500, 92\n")
        >>> sensor.Transmission.from_csv("glass.csv", percent=True).values
        tensor([0.0000, 0.9200], dtype=torch.float64)
        """
        table = spectral.read_csv(path, percent=percent)
        try:
            return cls(table)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def transmission(self, wavelengths: Tensor) -> Tensor:
        """T at the given wavelengths, (L,) float64."""
        check_trained(self.values, name="values of the transmission")
        grid = wavelengths.double().to(self.values.device)
        nodes = self.wavelengths.to(self.values.device)
        return self.values.double() @ spectral.interpolation(nodes, grid.clamp(nodes[0], nodes[-1]))

    def forward(self, signal: Tensor, context: Context | None = None) -> Tensor:
        """Bands (..., L, H, W) at the context's wavelengths to the same shape.

        Raises:    ValueError if the number of bands is not that of the wavelengths.
        """
        wavelengths = (context or Context()).wavelengths
        check_signal(signal, bands=len(wavelengths))
        if signal.ndim < 3 or signal.shape[-3] != len(wavelengths):
            raise ValueError(
                f"a Transmission takes bands (..., {len(wavelengths)}, H, W), one per wavelength, got shape "
                f"{tuple(signal.shape)}. Put it before the ColourFilter."
            )
        return signal * self.transmission(wavelengths).to(signal)[:, None, None]

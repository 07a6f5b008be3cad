"""Write kcam/tables/*.npz, the colorimetric tables that kcam reads at run time, from colour-science.

    python tools/make_tables.py            # into kcam/tables; the same bytes each time

colour-science is needed here and in the tests only: importing it takes over a second (see `import_colour`).
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import numpy as np

TABLES = Path(__file__).resolve().parent.parent / "kcam" / "tables"
ILLUMINANTS = ("A", "C", "D50", "D55", "D65", "D75", "E", "FL2", "FL7", "FL11", "HP1", "LED-B1", "LED-B3", "LED-B5")


def import_colour() -> ModuleType:
    """colour-science without its side effects.

    Without matplotlib it warns, and leaves MagicMock objects in sys.modules as `matplotlib`, `cycler` and others, so
    that a later `import matplotlib` seems to work. They are removed here.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    for name in [name for name, module in sys.modules.items() if isinstance(module, MagicMock)]:
        del sys.modules[name]
    return colour


def kodak(wavelengths: np.ndarray) -> np.ndarray:
    """A smooth approximation of the response of Kodak's colour interline CCDs without an infrared cut, (N, 3) R, G, B.

    Kodak publishes these curves as figures only. What is cited are the peaks: 470, 540 and 620 nm (data sheet
    KAC-12040/D, rev. 5, table 1, the same filters), quantum efficiency R 38 %, G 42 %, B 43 % (KAI-02170/D, table 1).
    The widths and the tails, sums of Gaussians, were drawn by eye after the figures of that family: red falls off
    slowly towards the infrared, and each dye leaks a few per cent outside its band.
    """

    def gaussians(*terms: tuple[float, float, float]) -> np.ndarray:
        return sum(height * np.exp(-0.5 * ((wavelengths - centre) / sigma) ** 2) for height, centre, sigma in terms)

    curves = np.stack(
        [
            gaussians((1.0, 614, 19), (0.72, 652, 34), (0.30, 710, 45), (0.05, 440, 40)),
            gaussians((1.0, 538, 33), (0.10, 600, 40), (0.06, 720, 45), (0.06, 450, 30)),
            gaussians((1.0, 472, 30), (0.20, 425, 25), (0.06, 540, 40), (0.03, 720, 45)),
        ],
        axis=1,
    )
    efficiency = curves / curves.max(axis=0) * (0.38, 0.42, 0.43)
    # A band of a scene is energy and a pixel counts photons: the response per unit of energy is efficiency * lambda.
    response = efficiency * wavelengths[:, None]
    return response / response[:, 1].max()


def build() -> dict[str, dict[str, np.ndarray]]:
    """All tables: file name -> array name -> array. Wavelengths are in nanometres, as in the sources."""
    colour = import_colour()
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    chart = colour.SDS_COLOURCHECKERS["BabelColor Average"]
    basis = colour.recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019
    cameras = colour.characterisation.MSDS_CAMERA_SENSITIVITIES
    nikon, sigma = cameras["Nikon 5100 (NPL)"], cameras["Sigma SDMerill (NPL)"]
    lamps = {name: colour.SDS_ILLUMINANTS[name] for name in ILLUMINANTS}
    grid = np.arange(360.0, 831.0, 5.0)  # the observer's range; a table that ends earlier is held constant (CIE 167)
    smooth = np.arange(380.0, 781.0, 5.0)
    return {
        "observer": {"wavelengths": observer.wavelengths, "values": observer.values},
        "illuminants": {
            "names": np.array(list(lamps)),
            "wavelengths": grid,
            "values": np.stack([np.interp(grid, lamp.wavelengths, lamp.values) for lamp in lamps.values()]),
        },
        "colour_chart": {
            "names": np.array(list(chart)),
            "wavelengths": next(iter(chart.values())).wavelengths,
            "values": np.stack([patch.values for patch in chart.values()]),
        },
        "rgb_basis": {"wavelengths": basis.wavelengths, "values": basis.values.T},
        "sensitivity_nikon_5100": {"wavelengths": nikon.wavelengths, "values": nikon.values.T},
        "sensitivity_sigma_sd_merrill": {"wavelengths": sigma.wavelengths, "values": sigma.values.T},
        "sensitivity_kodak": {"wavelengths": smooth, "values": kodak(smooth).T},
    }


def main() -> None:
    TABLES.mkdir(parents=True, exist_ok=True)
    for name, arrays in build().items():
        np.savez(TABLES / f"{name}.npz", **{key: np.ascontiguousarray(value) for key, value in arrays.items()})


if __name__ == "__main__":
    main()

"""Write tests/optics/optiland.npz, what Optiland says of kcam's lenses: wavefronts, chief rays and what passes.

    python tools/lens_goldens.py lenses FOLDER       # with kcam: each lens at each wavelength as a file of Optiland's
    python tools/lens_goldens.py optiland FOLDER     # with Optiland 0.6.3 in an environment of its own: the goldens

Glasses are numbers here, so that both trace the same indices; apertures clip, rays aim at the stop (`robust`), and the
wavefront is that on the sphere about the chief ray's image through the middle of the paraxial exit pupil.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from kcam.optics import CompoundLens

GOLDENS = Path(__file__).resolve().parent.parent / "tests" / "optics" / "optiland.npz"
LENSES = ("cooke_triplet", "double_gauss", "ef50", "phone", "phone_odd")
WAVELENGTHS = (450e-9, 550e-9, 650e-9)
FIELDS = (0.0, 0.3, 0.5, 0.7, 0.9)
"""Of a preset's field."""
SAMPLES, SHARES = 17, 65
"""Points across the stop, of a wavefront and for what passes."""


def at_wavelength(name: str, wavelength: float) -> CompoundLens:
    """A preset, its sensor in focus at 550 nm and infinity, with the indices of one wavelength [m] for all."""
    import torch

    from kcam.optics import CompoundLens
    from kcam.optics.compound.presets import preset_surfaces

    surfaces = preset_surfaces(name)
    grid = torch.tensor([wavelength], dtype=torch.float64)
    for surface in surfaces:
        if surface.glass is not None:
            surface.glass = float(surface.index(grid))
    distance = CompoundLens.preset(name).sensor_distance
    return CompoundLens(*surfaces, sensor_distance=distance, focus_wavelength=wavelength)


def write_lenses(folder: Path) -> None:
    """FOLDER/NAME-NANOMETRES.json, and the tangent of each preset's field."""
    from kcam.optics.compound.presets import PRESETS

    folder.mkdir(parents=True, exist_ok=True)
    for name in LENSES:
        for wavelength in WAVELENGTHS:
            at_wavelength(name, wavelength).save(folder / f"{name}-{round(wavelength * 1e9)}.json")
        (folder / f"{name}.field").write_text(repr(PRESETS[name].field))


def grid(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the stop's bounding square over its radius, rows along +y."""
    side = np.linspace(-1, 1, samples)
    x, y = np.meshgrid(side, side)
    return x.ravel(), y.ravel()


def optiland(folder: Path) -> None:
    """The goldens: for each lens waves (L, F, S, S), NaN where nothing passes, chief (L, F) [m], and open (L, F, S, S).

    open is 1 where a ray passes, 0 where it is clipped, and -1 where there is no stop, or Optiland aims no ray: of the
    phone it loses 4 % at 28 degrees, which pass when they are started where kcam starts them.
    """
    from optiland.distribution import BaseDistribution
    from optiland.fileio import load_optiland_file
    from optiland.wavefront import Wavefront

    class Points(BaseDistribution):
        def __init__(self, x: np.ndarray, y: np.ndarray) -> None:
            self.x, self.y = x, y

        def generate_points(self, num_points: int) -> None:
            raise NotImplementedError

    found: dict[str, np.ndarray] = {}
    for name in LENSES:
        field = float((folder / f"{name}.field").read_text())
        waves = np.full((len(WAVELENGTHS), len(FIELDS), SAMPLES, SAMPLES), np.nan)
        chief = np.zeros((len(WAVELENGTHS), len(FIELDS)))
        opened = np.full((len(WAVELENGTHS), len(FIELDS), SHARES, SHARES), -1, np.int8)
        for line, wavelength in enumerate(WAVELENGTHS):
            lens = load_optiland_file(folder / f"{name}-{round(wavelength * 1e9)}.json")
            lens.ray_tracer.set_aiming("robust", max_iter=200, tol=1e-12)
            lens.fields.fields.clear()
            for height in FIELDS:
                lens.fields.add(y=float(np.degrees(np.arctan(height * field))))
            largest = np.degrees(np.arctan(max(FIELDS) * field))
            for place, height in enumerate(FIELDS):
                point = (0.0, float(np.degrees(np.arctan(height * field)) / largest))
                micrometres = lens.wavelengths.primary_wavelength.value
                for samples in (SAMPLES, SHARES):
                    x, y = grid(samples)
                    inside = x**2 + y**2 <= 1 + 1e-12
                    kept = Wavefront(lens, [point], [micrometres], distribution=Points(x[inside], y[inside]))
                    data = kept.get_data(point, micrometres)
                    passed = np.asarray(data.intensity) > 0
                    late = -np.asarray(data.opd)  # ours is positive where light comes late
                    if samples == SHARES:
                        met = [np.asarray(at)[lens.surfaces.stop_index] for at in (lens.surfaces.x, lens.surfaces.y)]
                        reach = lens.aperture.value / 2
                        off = np.hypot(met[0] - x[inside] * reach, met[1] - y[inside] * reach)
                        opened[line, place][inside.reshape(samples, samples)] = np.where(off < 1e-6, passed, -1)
                    else:
                        values = np.full(samples**2, np.nan)
                        values[inside] = np.where(passed, late, np.nan)
                        waves[line, place] = values.reshape(samples, samples)
                chief[line, place] = data.reference_center[1] * 1e-3
        found |= {f"{name} waves": waves, f"{name} chief": chief, f"{name} open": opened}
        print(name, chief[1], [(part == 1).sum() for part in opened[1]], [(part < 0).sum() for part in opened[1]])
    np.savez_compressed(GOLDENS, **found)


if __name__ == "__main__":
    {"lenses": write_lenses, "optiland": optiland}[sys.argv[1]](Path(sys.argv[2]))

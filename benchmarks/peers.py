"""kcam beside TorchOptics, prysm and hcipy: one PSF, its error next to its time, and the hard cases of each.

    make bench-peers                     installs the peers into .venv-peers, then does the next line there; minutes
    python -m benchmarks.peers           prints the tables, writes benchmarks/results/peers.json
    python -m benchmarks.peers --quick   seconds, a toy size, nothing written; what is not installed is left out

All compute the same point-sampled PSF of an ideal lens, each as its own documentation does on a given pixel grid.
Error: L1 after scaling both pictures to unit sum, against float64 quadrature of the same physics. Time: the call alone;
a peer has its grids, masks, phases and matrices at hand (`setup`, counted apart), while kcam and the textbook make
theirs in every call.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import oracles
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks.baselines import angular_spectrum_psf, textbook_psf_bank
from benchmarks.common import ROOT, Contestant, environment, race, write_json
from kcam import optics
from kcam.units import mm, nm, um

RESULTS = ROOT / "benchmarks" / "results" / "peers.json"
PEERS = ("torchoptics", "prysm", "hcipy")
WAVELENGTH = 550 * nm
SINGLE, DOUBLE = torch.float32, torch.float64
Rows = list[dict[str, Any]]
Ready = tuple[Callable[[], Tensor], float]  # what is timed, and the share of the light that its unit stands for


@dataclass(frozen=True)
class Case:
    """A PSF: an ideal lens of f = `distance`, whose vergence (1 / object distance) and aberrations are given.

    defocus: path at the rim, spherical: RMS of Noll's Z11, both in waves and for the radius of 2.5 mm.
    """

    diameter: float = 5 * mm
    distance: float = 50 * mm
    pitch: float = 1 * um
    window: int = 297
    vergence: float = 0.0
    defocus: float = 0.0
    spherical: float = 0.0

    radius = 2.5 * mm

    @property
    def width(self) -> float:
        """Of the pupil's grid, which stays when the aperture is shut [m]."""
        return self.diameter or 2 * self.radius

    @property
    def shape(self) -> tuple[int, int]:
        return self.window, self.window

    def aberration(self, r2: Any) -> Any:
        """OPD [m] at squared radii; arrays or tensors."""
        rho2 = r2 / self.radius**2
        return WAVELENGTH * (self.defocus * rho2 + self.spherical * math.sqrt(5) * (6 * rho2 * (rho2 - 1) + 1))

    def residual(self, r2: Any) -> Any:
        """OPD beyond the sphere that focuses on the sensor, paraxially [m]."""
        return self.aberration(r2) + self.vergence / 2 * r2


TASK = Case(defocus=0.5, spherical=0.25)
QUICK = Case(defocus=0.5, spherical=0.25, pitch=2 * um, window=33)


@functools.cache
def truth(case: Case, *, paraxial: bool = True) -> Tensor:
    """Share of the light per pixel by float64 polar quadrature, once at every distinct radius of the picture.

    Raises: RuntimeError where twice the nodes give another picture: then it is no truth.
    """
    squared = np.add.outer(*[(np.arange(case.window) - case.window // 2) ** 2] * 2)
    radii, where = np.unique(squared, return_inverse=True)
    r = np.sqrt(radii) * case.pitch
    optic = {"aperture_radius": case.diameter / 2, "sensor_distance": case.distance, "wavelength": WAVELENGTH}
    pictures = []
    for more in (1, 2):
        if paraxial:
            opd = lambda u, v: case.residual(u**2 + v**2)  # noqa: E731
            values = oracles.fresnel_radial(r, opd=opd, radial_nodes=400 * more, **optic)
        else:  # the lens that images infinity perfectly, as kcam's ThinLens does
            def opd(u: Any, v: Any) -> Any:
                r2 = u**2 + v**2
                return case.aberration(r2) - r2 / (case.distance + np.sqrt(case.distance**2 + r2))

            points, counts = np.stack([r, 0 * r], axis=1), {"radial_nodes": 56 * more, "angular_nodes": 160 * more}
            values = oracles.rayleigh_sommerfeld(points, element_opd=opd, symmetric=True, **counts, **optic)
        pictures.append(torch.from_numpy(values)[torch.from_numpy(where.reshape(squared.shape))] * case.pitch**2)
    if (difference := l1(*pictures)) > 1e-8:
        raise RuntimeError(f"the quadrature has not converged: twice the nodes change it by {difference:.1e}.")
    return pictures[1]


def l1(picture: Tensor, reference: Tensor) -> float:
    """L1 between two pictures after scaling both to unit sum."""
    picture = picture.to(DOUBLE)
    return float((picture / picture.sum() - reference / reference.sum()).abs().sum())


# ---- the same PSF by each library: everything before `return` is setup ---------------------------------------------


class Spherical(optics.Element):
    """Noll's Z11 as an element of its own, which by its type is symmetric: what `radial` asks for."""

    symmetric = True

    def __init__(self, case: Case) -> None:
        super().__init__()
        self.case = case

    def terms(self, pupil: Any, wavelengths: Tensor) -> list[tuple[Tensor, Tensor]]:
        rho2 = pupil.rho2
        return [(torch.ones_like(wavelengths), self.case.spherical * WAVELENGTH * 5**0.5 * (6 * rho2 * (rho2 - 1) + 1))]


def kcam_psf(case: Case, *, dtype: torch.dtype = SINGLE, integrate: bool = False, **options: Any) -> Ready:
    """Options as `Lens.psf` has them. The call starts from coefficients, not from a pupil at hand."""
    elements: list[optics.Element] = [optics.CircularAperture(case.diameter), optics.ThinLens(case.distance)]
    if case.defocus:
        elements.append(optics.Defocus(2 * case.defocus * WAVELENGTH / case.radius**2))
    if case.spherical and options.get("method") == "radial":
        elements.append(Spherical(case))
    elif case.spherical:
        elements.append(optics.ZernikeAberration(case.spherical * WAVELENGTH * torch.eye(11, dtype=DOUBLE)[10]))
    lens = optics.Lens(*elements, sensor_distance=case.distance)
    where = {"distances": 1 / case.vergence if case.vergence else math.inf, "pixel_pitch": case.pitch}
    where |= {"shape": case.shape, "integrate": integrate, "dtype": dtype}
    return lambda: lens.psf([WAVELENGTH], **where, **options)[0, 0].detach(), 1.0


def textbook_psf(case: Case, *, samples: int) -> Ready:
    """A plano-convex lens of the same power; the map holds the aberration and what the sphere has beyond it."""
    radius, index = case.distance / 2, 1.5
    axis = (torch.arange(samples, dtype=DOUBLE) - (samples - 1) / 2) * (case.diameter / samples)
    r2 = axis[:, None] ** 2 + axis**2
    sphere = (index - 1) * r2**2 / (2 * radius * (radius + torch.sqrt(radius**2 - r2)) ** 2)
    optic = {"aperture_diameter": case.diameter, "radius_of_curvature": radius, "sensor_distance": case.distance}
    optic |= {"wavelengths": torch.tensor([WAVELENGTH], dtype=DOUBLE), "lens_index": torch.tensor([index], dtype=DOUBLE)}
    optic |= {"distances": torch.tensor([math.inf], dtype=DOUBLE), "pixel_pitch": case.pitch, "shape": case.shape}
    phase = 2 * math.pi / WAVELENGTH * (case.aberration(r2) + sphere)
    return lambda: textbook_psf_bank(phase, **optic)[0, 0], 1.0


def textbook_spectrum(case: Case, *, margin: float) -> Ready:
    """The angular spectrum on a grid of the pixels' pitch, `margin` times as wide as aperture and window together."""
    samples = 2 * math.ceil(margin * (case.diameter + case.window * case.pitch) / (2 * case.pitch))
    axis = (torch.arange(samples, dtype=DOUBLE) - samples // 2) * case.pitch
    r2 = axis[:, None] ** 2 + axis**2
    opd = case.aberration(r2) - r2 / (case.distance + torch.sqrt(case.distance**2 + r2))
    optic = {"aperture_diameter": case.diameter, "sensor_distance": case.distance, "grid_pitch": case.pitch}
    return lambda: angular_spectrum_psf(opd, wavelength=WAVELENGTH, shape=case.shape, **optic), 1.0


def hcipy_psf(case: Case, *, samples: int, dtype: torch.dtype = DOUBLE) -> Ready:
    """FraunhoferPropagator onto a uniform grid: hcipy's matrix Fourier transform; the aperture's edge supersampled."""
    import hcipy

    grid = hcipy.make_pupil_grid(samples, case.width)
    aperture = hcipy.evaluate_supersampled(hcipy.make_circular_aperture(case.diameter), grid, 8)
    values = aperture * np.exp(2j * np.pi / WAVELENGTH * case.residual(grid.x**2 + grid.y**2))
    wavefront = hcipy.Wavefront(hcipy.Field(values.astype(_complex(dtype)), grid), WAVELENGTH)
    wavefront.total_power = 1
    pixels = hcipy.make_uniform_grid(case.shape, case.window * case.pitch, has_center=True)
    propagator = hcipy.FraunhoferPropagator(grid, pixels, focal_length=case.distance)
    return lambda: _tensor(propagator(wavefront).power.shaped), 1.0


def hcipy_spectrum(case: Case, *, samples: int, dtype: torch.dtype) -> Ready:
    """Lens and AngularSpectrumPropagator on one grid of the pixels' pitch."""
    import hcipy

    grid = hcipy.make_uniform_grid([samples] * 2, samples * case.pitch, has_center=True)
    r2 = grid.x**2 + grid.y**2
    aperture = hcipy.make_circular_aperture(case.diameter)(grid)
    values = aperture * np.exp(-1j * np.pi / (WAVELENGTH * case.distance) * r2)
    wavefront = hcipy.Wavefront(hcipy.Field(values.astype(_complex(dtype)), grid), WAVELENGTH)
    wavefront.total_power = 1
    propagator = hcipy.AngularSpectrumPropagator(grid, case.distance)
    return lambda: _centre(_tensor(propagator(wavefront).power.shaped), case), 1.0


def prysm_psf(case: Case, *, samples: int, dtype: torch.dtype = DOUBLE, method: str = "mdft") -> Ready:
    """focus_fixed_sampling: a matrix DFT (mdft) or a chirp z-transform (czt); mm, um and nm as prysm has them."""
    from prysm import coordinates, fttools, geometry, propagation
    from prysm.conf import config

    config.precision = 32 if dtype == SINGLE else 64
    x, y = coordinates.make_xy_grid(samples, diameter=case.width / mm)
    r, _ = coordinates.cart_to_polar(x, y)
    mask = geometry.circle(case.diameter / 2 / mm, r)
    wavefront = propagation.Wavefront.from_amp_and_phase(
        mask, case.residual((r * mm) ** 2) / nm, WAVELENGTH / um, case.width / mm / samples
    )
    wavefront.data = wavefront.data.astype(_complex(dtype))
    engine = fttools.MatrixDFTExecutor()  # prysm's own keeps its matrices without their precision: one for each here

    def psf() -> Tensor:
        config.precision, propagation.mdft = 32 if dtype == SINGLE else 64, engine
        focused = wavefront.focus_fixed_sampling(case.distance / mm, case.pitch / um, case.window, method=method)
        return _tensor(focused.intensity.data)

    return psf, 1 / max(1.0, float(mask.sum()))


def prysm_spectrum(case: Case, *, samples: int, dtype: torch.dtype) -> Ready:
    """Lens and free_space on one grid of the pixels' pitch."""
    from prysm import coordinates, geometry, propagation
    from prysm.conf import config

    config.precision = 32 if dtype == SINGLE else 64
    x, y = coordinates.make_xy_grid(samples, dx=case.pitch / mm)
    r, _ = coordinates.cart_to_polar(x, y)
    mask = geometry.circle(case.diameter / 2 / mm, r)
    opd = -((r * mm) ** 2) / (2 * case.distance) / nm
    wavefront = propagation.Wavefront.from_amp_and_phase(mask, opd, WAVELENGTH / um, case.pitch / mm)
    wavefront.data = wavefront.data.astype(_complex(dtype))

    def psf() -> Tensor:
        config.precision = 32 if dtype == SINGLE else 64
        return _centre(_tensor(wavefront.free_space(case.distance / mm, Q=1).intensity.data), case)

    return psf, 1 / float(mask.sum())


def torchoptics_psf(
    case: Case, *, spacing: float, dtype: torch.dtype = DOUBLE, spherical_source: float | None = None, **options: Any
) -> Ready:
    """Field.propagate from the lens onto the pixels; options are its own. `spherical_source`: where its wave starts."""
    import torchoptics
    from torchoptics import profiles

    torchoptics.set_default_dtype(dtype)
    samples = round(case.width / spacing)
    grid = {"shape": (samples, samples), "spacing": spacing}
    x, y = torchoptics.PlanarGrid(**grid).meshgrid()
    phase = profiles.lens_phase(focal_length=case.distance, wavelength=WAVELENGTH, **grid)
    phase = phase + 2 * math.pi / WAVELENGTH * case.residual(x**2 + y**2)
    if spherical_source is not None:
        phase = phase + profiles.spherical_wave_phase(z=spherical_source, wavelength=WAVELENGTH, **grid)
    light = torch.polar(profiles.circle(radius=case.diameter / 2, **grid), phase)
    pupil = torchoptics.Field(light, WAVELENGTH, z=0, spacing=spacing)
    interpolation = "nearest" if spacing == case.pitch else "bicubic"

    def psf() -> Tensor:
        torchoptics.set_default_dtype(dtype)
        plane = {"z": case.distance, "spacing": case.pitch, "interpolation_mode": interpolation}
        return pupil.propagate(case.shape, **plane, **options).intensity()

    return psf, case.pitch**2 / float(pupil.power())


def _complex(dtype: torch.dtype) -> str:
    return "complex64" if dtype == SINGLE else "complex128"


def _tensor(values: Any) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values))


def _centre(picture: Tensor, case: Case) -> Tensor:
    first = picture.shape[-1] // 2 - case.window // 2
    return picture[first : first + case.window, first : first + case.window]


# ---- accuracy against time -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Entry:
    """Who computes the task, and how. slow: timed once. paraxial: whether the model is Fresnel's."""

    who: str
    prepare: Callable[..., Ready]
    options: dict[str, Any] = field(default_factory=dict)
    dtype: torch.dtype = DOUBLE
    slow: bool = False
    paraxial: bool = True


def entries(*, quick: bool) -> list[Entry]:
    """The textbook first, as the baseline of the ratios; then kcam, then the peers."""
    spectrum = {"propagator": "angular_spectrum"}
    found = [Entry(f"textbook, {n} samples", textbook_psf, {"samples": n}) for n in ((64,) if quick else (891, 512, 256))]
    for dtype in (SINGLE, DOUBLE):
        for method, counts in (("matrix", (64, 128, 256, 512, None)), ("chirp_z", (256, None)), ("radial", (None,))):
            for samples in counts[-2:] if quick else counts:
                options = {"propagator": "fresnel", "method": method, "samples": samples, "dtype": dtype}
                found.append(Entry(f"kcam {method}, {samples or 'its own'} samples", kcam_psf, options, dtype))
        if not quick:
            found.append(Entry("kcam angular_spectrum", kcam_psf, spectrum | {"dtype": dtype}, dtype, True, False))
    for dtype, counts in ((DOUBLE, (64,) if quick else (128, 256, 512, 1024, 2048)), (SINGLE, () if quick else (512, 1024))):
        for samples in counts:
            options = {"samples": samples, "dtype": dtype}
            found.append(Entry(f"hcipy Fraunhofer, {samples} samples", hcipy_psf, options, dtype))
            found.append(Entry(f"prysm mdft, {samples} samples", prysm_psf, options, dtype))
    if quick:
        return found
    found.append(Entry("textbook angular spectrum", textbook_spectrum, {"margin": 1.25}, slow=True, paraxial=False))
    for samples in (512, 1024):
        found.append(Entry(f"prysm czt, {samples} samples", prysm_psf, {"samples": samples, "method": "czt"}))
    for dtype, micrometres, method in (
        (DOUBLE, 4, "DIM_FRESNEL"), (DOUBLE, 2, "DIM_FRESNEL"), (DOUBLE, 1, "DIM_FRESNEL"), (SINGLE, 1, "DIM_FRESNEL"),
        (DOUBLE, 4, "ASM_FRESNEL"),
    ):  # fmt: skip
        options = {"spacing": micrometres * um, "dtype": dtype, "propagation_method": method}
        who = f"torchoptics {method}, spacing {micrometres} um"
        found.append(Entry(who, torchoptics_psf, options, dtype, micrometres == 1))
    return found


def accuracy_rows(case: Case, *, installed: list[str], quick: bool) -> Rows:
    """A row for each entry whose library is installed: benchmarks.common's, and its setup [CPU s] and physics."""
    contestants, extra = [], []
    for entry in entries(quick=quick):
        library = entry.who.split()[0].rstrip(",")
        if library in PEERS and library not in installed:
            continue
        start = time.process_time()
        psf, _ = entry.prepare(case, **entry.options)
        extra.append(
            {
                "library": library,
                "setup": time.process_time() - start,
                "samples": entry.options.get("samples"),
                "physics": "Fresnel" if entry.paraxial else "Rayleigh-Sommerfeld",
            }
        )
        reference = truth(case, paraxial=entry.paraxial)
        check = functools.partial(lambda picture, reference: {"l1": l1(picture, reference)}, reference=reference)
        dtype = str(entry.dtype).removeprefix("torch.")
        contestants.append(Contestant(entry.who, psf, check, dtype=dtype, once=entry.slow))
    size = f"{case.window}^2 at {case.pitch / um:g} um"
    rows = race("one PSF", size=size, direction="forward", contestants=contestants, seconds=0 if quick else 40.0)
    return [row | more for row, more in zip(rows, extra, strict=True)]


# ---- hard cases ----------------------------------------------------------------------------------------------------


def outcome(prepare: Callable[[], Ready], reference: Tensor | None) -> dict[str, Any]:
    """What came of it: `finite`, `NaN` or `raises`; the L1, the light in the window, and what was said about it."""
    found: dict[str, Any] = {"outcome": "raises", "l1": None, "energy": None, "message": None}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            psf, unit = prepare()
            picture = psf().to(DOUBLE)
        except Exception as error:  # noqa: BLE001: whatever a library says is what is recorded
            return found | {"message": f"{type(error).__name__}: {error}"}
    found["warnings"] = sorted({f"{warning.category.__name__}: {warning.message}" for warning in said})
    if not picture.isfinite().all():
        return found | {"outcome": "NaN"}
    if reference is not None and picture.sum() > 0:
        found["l1"] = l1(picture, reference)
    return found | {"outcome": "finite", "energy": float(picture.sum()) * unit}


def hard_cases() -> list[tuple[str, Case, list[tuple[str, str, Callable[..., Ready], dict[str, Any]]]]]:
    """(what is hard, the case, [(library, how, function, options)]). All but the third are without aberration."""
    one_micron = {"spacing": 1 * um, "propagation_method": "DIM_FRESNEL"}
    far = Case(distance=1e7 * WAVELENGTH / (2 * math.pi), pitch=20 * um, window=99)
    wide = {"samples": 2048}  # 41 mm: the transfer function is sampled well enough
    travel: list[tuple[str, str, Callable[..., Ready], dict[str, Any]]] = []
    for dtype in (SINGLE, DOUBLE):
        own = {"dtype": dtype}
        travel += [
            ("kcam", "nonparaxial", kcam_psf, own),
            ("kcam", "angular_spectrum", kcam_psf, own | {"propagator": "angular_spectrum"}),
            ("torchoptics", "ASM", torchoptics_psf, own | {"propagation_method": "ASM", "asm_pad": 899} | {"spacing": 20 * um}),
            ("torchoptics", "DIM", torchoptics_psf, own | {"propagation_method": "DIM", "spacing": 20 * um}),
            ("prysm", "free_space", prysm_spectrum, own | wide),
            ("hcipy", "AngularSpectrumPropagator", hcipy_spectrum, own | wide),
        ]

    def coarse(spacing: float, samples: int) -> list[tuple[str, str, Callable[..., Ready], dict[str, Any]]]:
        dim = {"spacing": spacing, "propagation_method": "DIM_FRESNEL"}
        return [
            ("torchoptics", f"DIM_FRESNEL, spacing {spacing / um:.3g} um", torchoptics_psf, dim),
            ("prysm", f"mdft, {samples} samples", prysm_psf, {"samples": samples}),
            ("hcipy", f"Fraunhofer, {samples} samples", hcipy_psf, {"samples": samples}),
        ]

    fresnel = {"propagator": "fresnel"}
    infinity = [("torchoptics", "spherical_wave_phase(z=inf)", torchoptics_psf, one_micron | {"spherical_source": math.inf})]
    return [
        ("point source at infinity", Case(window=99), [
            ("kcam", "distances=inf", kcam_psf, fresnel), *infinity, *coarse(4 * um, 512)[1:],
        ]),
        ("k z = 1e7", far, travel),
        ("zero aperture", Case(diameter=0.0, window=99), [("kcam", "", kcam_psf, fresnel), *coarse(4 * um, 512)]),
        ("PSF under one pixel", Case(pitch=50 * um, window=21), [
            ("kcam", "", kcam_psf, fresnel | {"integrate": True}), *coarse(4 * um, 512),
        ]),
        ("object at 5 cm", Case(vergence=20.0), [
            ("kcam", "its own samples", kcam_psf, fresnel),
            ("kcam", "512 samples", kcam_psf, fresnel | {"samples": 512}),
            *coarse(5 * mm / 512, 512),
        ]),
    ]  # fmt: skip


def hard_rows(installed: list[str]) -> Rows:
    """A row for each hard case and library."""
    rows = []
    for name, case, attempts in hard_cases():
        reference = truth(case) if case.diameter else None
        true_energy = None if reference is None else float(reference.sum())
        for library, how, function, options in attempts:
            if library not in ("kcam", *installed):
                continue
            dtype = options.get("dtype", SINGLE if library == "kcam" else DOUBLE)
            row = {"case": name, "library": library, "how": how, "dtype": str(dtype).removeprefix("torch.")}
            row |= {"true_energy": true_energy} | outcome(functools.partial(function, case, **options), reference)
            rows.append(row)
    return rows


# ---- the whole -----------------------------------------------------------------------------------------------------


def find_peers(console: Console, names: tuple[str, ...] = PEERS) -> tuple[dict[str, str], dict[str, str]]:
    """Versions of the peers that can be imported, and why the others cannot; says so."""
    versions, skipped = {}, {}
    for name in names:
        try:
            importlib.import_module(name)
            versions[name] = metadata.version(name)
        except Exception as error:  # noqa: BLE001: an installed peer may fail in any way beside newer libraries
            skipped[name] = f"{type(error).__name__}: {error}"
            console.print(f"{name} is skipped: {skipped[name]} (`make bench-peers` installs the peers)")
    return versions, skipped


def print_accuracy(console: Console, rows: Rows) -> None:
    """Error beside time, the most accurate last; a star where no other is both faster and closer."""
    table = Table(title=f"[bold]one PSF[/], {rows[0]['size']}", box=None, title_justify="left")
    table.add_column("", min_width=38)
    for name in ("L1", "CPU ms", "IQR", "setup ms", "MB"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in sorted(rows, key=lambda row: -row["error"]["l1"]):
        better = [o for o in rows if o["error"]["l1"] < row["error"]["l1"] and o["seconds"] < row["seconds"]]
        low, high = (f"{t * 1e3:.3g}" for t in row["seconds_iqr"])
        memory = "-" if row["peak_memory"] is None else f"{row['peak_memory'] / 1e6:.0f}"
        who = f"{'*' if not better else ' '} {row['who']}, {row['dtype']}"
        table.add_row(
            who, f"{row['error']['l1']:.1e}", f"{row['seconds'] * 1e3:.3g}", f"{low}-{high}",
            f"{row['setup'] * 1e3:.0f}", memory,
        )  # fmt: skip
    console.print(table, "")


def print_hard(console: Console, rows: Rows) -> None:
    """What came of every hard case."""
    table = Table(title="[bold]hard cases[/]", box=None, title_justify="left")
    for name in ("case", "", "outcome", "L1", "energy", "true", "said"):
        table.add_column(name, overflow="fold")
    for row in rows:
        numbers = ["-" if row[key] is None else f"{row[key]:.3g}" for key in ("l1", "energy", "true_energy")]
        said = row["message"] or "; ".join(row["warnings"]) or "nothing"
        table.add_row(row["case"], f"{row['library']} {row['how']}, {row['dtype']}", row["outcome"], *numbers, said)
    console.print(table, "")


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description="kcam beside its peers")
    parser.add_argument("--quick", action="store_true", help="a toy size without hard cases; nothing written")
    parser.add_argument("--out", type=Path, help=f"where to write JSON (default: {RESULTS.relative_to(ROOT)})")
    options = parser.parse_args(arguments)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        console = Console()
        console.width = max(console.width, 130)
        versions, skipped = find_peers(console)
        case = QUICK if options.quick else TASK
        rows = accuracy_rows(case, installed=list(versions), quick=options.quick)
        hard = [] if options.quick else hard_rows(list(versions))
        where = environment()
    finally:
        torch.set_num_threads(threads)
    where["versions"] |= versions
    print_accuracy(console, rows)
    print_hard(console, hard)
    out = options.out or (None if options.quick else RESULTS)
    if out is not None:
        write_json(out, {"environment": where, "skipped": skipped, "accuracy": rows, "hard_cases": hard})
        console.print(f"written to {out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

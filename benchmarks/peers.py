"""kcam beside TorchOptics, prysm and hcipy: one PSF, its error next to its time, and the hard cases of each.

    make bench-peers                     installs the peers into .venv-peers, then does the next line there; minutes
    python -m benchmarks.peers           prints the tables, writes benchmarks/results/peers.json
    python -m benchmarks.peers --quick   seconds, a toy size, nothing written; what is not installed is left out

All compute the same point-sampled PSF of an ideal lens, each as its own documentation does on a given pixel grid.
Error: L1 after scaling both pictures to unit sum, against float64 quadrature of the same physics. Time: the call alone;
a peer has its grids, masks, phases and matrices at hand (counted apart, as `setup` and in `first_call`), while kcam
and the textbook make theirs in every call.
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

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks.common import ROOT, Contestant, environment, race, write_json
from benchmarks.peer_psfs import (
    DOUBLE,
    EXACT,
    SINGLE,
    WAVELENGTH,
    Case,
    Ready,
    hcipy_psf,
    kcam_psf,
    l1,
    prysm_psf,
    textbook_psf,
    textbook_spectrum,
    torchoptics_psf,
    truth,
)
from kcam.units import mm, um

RESULTS = ROOT / "benchmarks" / "results" / "peers.json"
PEERS = ("torchoptics", "prysm", "hcipy")
TASK = Case(defocus=0.5, spherical=0.25)
QUICK = Case(defocus=0.5, spherical=0.25, pitch=2 * um, window=33)
Rows = list[dict[str, Any]]

# ---- accuracy against time -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Entry:
    """Who computes the task, and how. slow: timed once. physics: that of its truth."""

    who: str
    prepare: Callable[..., Ready]
    options: dict[str, Any] = field(default_factory=dict)
    dtype: torch.dtype = DOUBLE
    slow: bool = False
    physics: str = "Fresnel"


def entries(*, quick: bool) -> list[Entry]:
    """The textbook first, as the baseline of the ratios; then kcam, then the peers."""
    spectrum = {"propagator": "angular_spectrum"}
    counts = (64,) if quick else (891, 512, 256)
    found = [Entry(f"textbook, {n} samples", textbook_psf, {"samples": n}) for n in counts]
    for dtype in (SINGLE, DOUBLE):
        for method, counts in (("matrix", (96, 128, 256, 512, None)), ("chirp_z", (256, None)), ("radial", (None,))):
            for samples in counts[-2:] if quick else counts:
                options = {"propagator": "fresnel", "method": method, "samples": samples, "dtype": dtype}
                found.append(Entry(f"kcam {method}, {samples or 'its own'} samples", kcam_psf, options, dtype))
        if not quick:
            found.append(Entry("kcam angular_spectrum", kcam_psf, spectrum | {"dtype": dtype}, dtype, True, EXACT))
    for dtype, counts in ((DOUBLE, (128, 256, 512, 1024, 2048)), (SINGLE, (512, 1024))):
        for samples in counts[:1] if quick else counts:
            own = {"samples": samples, "dtype": dtype}
            found.append(Entry(f"hcipy Fraunhofer, {samples} samples", hcipy_psf, own, dtype))
            found.append(Entry(f"prysm mdft, {samples - 1} samples", prysm_psf, own | {"samples": samples - 1}, dtype))
    if quick:
        return found
    found.append(Entry("textbook angular spectrum", textbook_spectrum, {"margin": 1.25}, slow=True, physics=EXACT))
    for samples in (511, 1023):
        found.append(Entry(f"prysm czt, {samples} samples", prysm_psf, {"samples": samples, "method": "czt"}))
    pad = {"asm_pad": 387}  # 8.1 mm in all: enough for the transfer function, a tenth of the default's time
    for dtype, micrometres, method, own in (
        (DOUBLE, 4, "DIM_FRESNEL", {}), (DOUBLE, 2, "DIM_FRESNEL", {}), (DOUBLE, 1, "DIM_FRESNEL", {}),
        (SINGLE, 1, "DIM_FRESNEL", {}), (DOUBLE, 4, "ASM_FRESNEL", pad),
    ):  # fmt: skip
        own = own | {"spacing": micrometres * um, "dtype": dtype, "propagation_method": method}
        who = f"torchoptics {method}, {micrometres} um"
        found.append(Entry(who, torchoptics_psf, own, dtype, micrometres == 1))
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
        extra.append({"library": library, "physics": entry.physics, "setup": time.process_time() - start})
        reference = truth(case, physics=entry.physics)
        check = functools.partial(lambda picture, reference: {"l1": l1(picture, reference)}, reference=reference)
        dtype = str(entry.dtype).removeprefix("torch.")
        contestants.append(Contestant(entry.who, psf, check, dtype=dtype, once=entry.slow))
    size = f"{case.window}^2 at {case.pitch / um:g} um"
    rows = race("one PSF", size=size, direction="forward", contestants=contestants, seconds=0 if quick else 40.0)
    return [row | more for row, more in zip(rows, extra, strict=True)]


# ---- hard cases ----------------------------------------------------------------------------------------------------


def outcome(prepare: Callable[[], Ready], reference: Tensor | None) -> dict[str, Any]:
    """What came of it: `finite`, `NaN` or `raises`; the L1, the light in the window, and what was said about it."""
    found: dict[str, Any] = {"outcome": "raises", "l1": None, "energy": None, "message": None, "warnings": []}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            psf, unit = prepare()
            picture = psf().to(DOUBLE)
        except Exception as error:  # whatever a library says is what is recorded
            return found | {"message": f"{type(error).__name__}: {error}"}
    found["warnings"] = sorted({f"{warning.category.__name__}: {warning.message}" for warning in said})
    if not picture.isfinite().all():
        return found | {"outcome": "NaN"}
    if reference is not None and picture.sum() > 0:
        found["l1"] = l1(picture, reference)
    return found | {"outcome": "finite", "energy": float(picture.sum()) * unit}


Attempt = tuple[str, str, Callable[..., Ready], dict[str, Any]]  # library, how, function, its options


def hard_cases() -> list[tuple[str, Case, str, list[Attempt]]]:
    """(what is hard, the case, physics of its truth, who attempts it how). None has aberrations."""
    fresnel = {"propagator": "fresnel"}

    def peers(spacing: float = 4 * um, **more: Any) -> list[Attempt]:
        dim = {"spacing": spacing, "propagation_method": "DIM_FRESNEL"}
        source, plane = (", spherical_wave_phase", ", a plane wave: it has no point source") if more else ("", "")
        return [
            ("torchoptics", f"DIM_FRESNEL, {spacing / um:.3g} um{source}", torchoptics_psf, dim | more),
            ("prysm", f"mdft, 511 samples{plane}", prysm_psf, {"samples": 511}),
            ("hcipy", f"Fraunhofer, 512 samples{plane}", hcipy_psf, {"samples": 512}),
        ]

    travel: list[Attempt] = []
    for dtype in (SINGLE, DOUBLE):
        own, asm = {"dtype": dtype}, {"propagation_method": "ASM", "asm_pad": 887, "spacing": 20 * um}
        wide = own | {"samples": 2049, "spectrum": True}  # 41 mm: the transfer function is sampled well enough
        travel += [
            ("kcam", "nonparaxial", kcam_psf, own),
            ("kcam", "angular_spectrum", kcam_psf, own | {"propagator": "angular_spectrum"}),
            ("torchoptics", "ASM", torchoptics_psf, own | asm),
            ("torchoptics", "DIM", torchoptics_psf, own | {"propagation_method": "DIM", "spacing": 20 * um}),
            ("prysm", "free_space", prysm_psf, wide),
            ("hcipy", "AngularSpectrumPropagator", hcipy_psf, wide),
        ]
    far = Case(distance=1e7 * WAVELENGTH / (2 * math.pi), pitch=20 * um, window=99)
    ours: Attempt = ("kcam", "", kcam_psf, fresnel)
    pixels: Attempt = ("kcam", "integrate=True", kcam_psf, fresnel | {"integrate": True})
    few: Attempt = ("kcam", "512 samples", kcam_psf, fresnel | {"samples": 512})
    return [
        ("point source at infinity", Case(window=99), "Fresnel", [ours, *peers(spherical_source=math.inf)]),
        ("k z = 1e7", far, EXACT, travel),
        ("zero aperture", Case(diameter=0.0, window=99), "none", [ours, *peers()]),
        ("PSF under one pixel", Case(pitch=50 * um, window=21), "pixels", [pixels, *peers()]),
        ("object at 5 cm", Case(vergence=20.0, pitch=10 * um), "Fresnel", [ours, few, *peers(5 * mm / 512)]),
    ]


def hard_rows(installed: list[str]) -> Rows:
    """A row for each hard case and library."""
    rows = []
    for name, case, physics, attempts in hard_cases():
        reference = truth(case, physics=physics) if case.diameter else None
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
        except Exception as error:  # an installed peer may fail in any way beside newer libraries
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

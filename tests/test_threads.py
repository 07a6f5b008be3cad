"""Threads: no more than other work leaves cores, put back, and left alone where the last bit counts."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator

import pytest
import torch
from torch import nn

from kcam import Camera, Scene, optics, style, threads
from kcam.units import mm, nm, um

AVAILABLE = 3


class Watch(nn.Module):
    """A stage, a style's features or a lens's element that notes how many threads it is computed with."""

    multiple, least, width = 1, 1, 1

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[int] = []

    def forward(self, signal: torch.Tensor) -> torch.Tensor:
        self.seen.append(torch.get_num_threads())
        return signal


class WatchedLens(optics.ThinLens):
    """A thin lens that notes the threads."""

    def terms(self, pupil, wavelengths):
        self.seen = torch.get_num_threads()
        return super().terms(pupil, wavelengths)


@pytest.fixture(autouse=True)
def several() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(AVAILABLE)
    yield
    assert torch.get_num_threads() == AVAILABLE, "threads were not put back"
    torch.set_num_threads(before)


@pytest.fixture(params=[-2, 0, 1, 2, 3, 64])
def free(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """So many cores are free."""
    monkeypatch.setattr(threads, "free_cores", lambda: request.param)
    threads._seen.set((-1.0, 1))
    return request.param


def expected(free: int) -> int:
    return min(AVAILABLE, max(1, free))


def test_a_camera_takes_no_more_threads_than_are_free(free: int) -> None:
    watch = Watch()
    Camera(watch)(torch.rand(1, 28, 4, 4))
    assert watch.seen == [expected(free)]


def test_so_do_optics_alone_and_their_gradients(free: int) -> None:
    element = WatchedLens(nn.Parameter(torch.tensor(50 * mm)))
    lens = optics.Lens(optics.CircularAperture(2 * mm), element, focus_distance=2.0)
    psf = lens.psf([550 * nm], distances=2.0, pixel_pitch=4 * um, shape=(9, 9))
    assert element.seen == expected(free)
    element.seen = 0
    optics.Imaging(lens)(Scene.builtin("colour_chart", 24))
    assert element.seen == expected(free)
    psf.sum().backward()


def test_so_does_painting(free: int) -> None:
    seen = []

    class Features(style.SteerableFeatures):
        def forward(self, *arguments, **settings):
            seen.append(torch.get_num_threads())
            return super().forward(*arguments, **settings)

    loss = style.StyleLoss(style.painting("mosaic", size=64), features=Features())
    seen.clear()
    style.paint(loss, photo=torch.rand(3, 64, 64), steps=1)
    assert set(seen) == {expected(free)}


def test_what_is_held_stays(free: int) -> None:
    watch = Watch()
    with threads.fixed(2):
        Camera(watch)(torch.rand(1, 28, 4, 4))
    with threads.fixed():
        Camera(watch)(torch.rand(1, 28, 4, 4))
    assert watch.seen == [2, AVAILABLE]


def test_other_processes_are_seen_while_they_run() -> None:
    """At least the one that is started here; how many more run is the machine's business."""
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        try:
            end = time.monotonic() + 60
            while threads._running_elsewhere() < 1 and time.monotonic() < end:
                time.sleep(0.01)
            found = threads._running_elsewhere()
        finally:
            busy.kill()
    if not threads.LOAD.exists():
        pytest.skip("this system does not say what runs")
    assert found >= 1

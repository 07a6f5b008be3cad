"""The benchmarks run, at toy sizes, and what they write down is what they measured."""

from __future__ import annotations

import copy
import itertools
import json
import math
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import oracles
import pytest
import torch
from rich.console import Console

sys.path.append(str(Path(__file__).parents[1]))

from benchmarks import against, augmentation, bench, gpu, peers, style_step
from benchmarks import field as over_field
from benchmarks import patches as patch_stores
from benchmarks.common import Contestant, race
from kcam import augmentation as KC


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> dict:
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    assert bench.main(["--quick", "--out", str(path)]) == 0
    return json.loads(path.read_text())


def test_each_race_has_a_textbook_and_kcam_with_its_default(content):
    races = {}
    for row in content["rows"]:
        races.setdefault((row["op"], row["direction"]), []).append(row)
    assert {direction for _, direction in races} == {"forward", "forward + backward"}
    assert len(races) == 5 + 6 + 1 + 12
    for rows in races.values():
        assert rows[0]["baseline"]
        assert rows[0]["ratio"] == 1
        assert any(row["default"] for row in rows)


def test_rows_say_where_when_and_how_exactly(content):
    assert {"date", "commit", "versions", "machine", "threads"} <= content["environment"].keys()
    for row in content["rows"]:
        assert row["seconds"] > 0
        assert row["device"] == "cpu"
        assert row["threads"] == 1
        assert all(math.isfinite(value) for value in row["error"].values())


def test_kcam_is_closer_to_the_truth_than_the_textbook(content):
    for row in content["rows"]:
        if not row["baseline"] and "l1_max" in row["error"]:
            assert row["error"]["l1_max"] < 2e-3
            assert row["error_ratio"] > 10
        assert row["error"].get("relative_max", 0) < 1e-5
        if not row["baseline"]:
            assert row["error"].get("gradient", 0) < 5e-3
            assert row["error"].get("1 - cosine", 0) < 1e-5


def test_time_is_counted_for_the_whole_where_a_share_is_run():
    def work() -> torch.Tensor:
        return torch.ones(400, 400) @ torch.ones(400, 400)

    contestants = [
        Contestant("textbook", work, lambda _: {"l1_max": 1e-2}, share=0.1),
        Contestant("textbook, finer", work, lambda _: {"l1_max": 1e-3}, once=True),
        Contestant("kcam", work, lambda _: {"l1_max": 1e-5}),
    ]
    base, finer, ours = race("toy", size="1", direction="forward", contestants=contestants, seconds=0.05)
    assert base["rounds"] >= 3
    assert finer["calls"] == 1
    assert 3 < ours["ratio"] < 40
    assert ours["error_ratio"] == pytest.approx(100)


@pytest.mark.parametrize(("ratio", "difference", "met"), [(2.1, 1e-6, True), (1.9, 1e-6, False), (2.1, 1e-4, False)])
def test_a_target_is_met_only_when_fast_and_the_same(ratio, difference, met):
    row = {"op": "render cube", "direction": "forward", "who": "kcam", "default": True, "ratio": ratio}
    row |= {"error": {"relative_max": difference}, "error_ratio": None}
    target = bench.Target("cube", "render cube", 2, same_to=1e-5)
    assert [verdict["met"] for verdict in target.judge([row])] == [met]


# ---- beside the peers ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def beside_peers(tmp_path_factory: pytest.TempPathFactory) -> dict:
    path = tmp_path_factory.mktemp("peers") / "peers.json"
    assert peers.main(["--quick", "--out", str(path)]) == 0
    return json.loads(path.read_text())


def test_kcam_and_the_textbook_run_where_no_peer_is_installed(beside_peers):
    rows = beside_peers["accuracy"]
    assert {"textbook", "kcam"} <= {row["library"] for row in rows}
    assert {row["library"] for row in rows} | beside_peers["skipped"].keys() == {"textbook", "kcam", *peers.PEERS}
    for row in rows:
        assert row["seconds"] > 0
        # 64 samples in the textbook's hard-edged pupil are good to 1.2e-2; kcam's own choice promises 1e-3 here
        assert row["error"]["l1"] < (1e-3 if row["library"] == "kcam" else 3e-2), row["who"]


def test_more_samples_are_closer(beside_peers):
    error = {(row["who"], row["dtype"]): row["error"]["l1"] for row in beside_peers["accuracy"]}
    for dtype in ("float32", "float64"):
        assert error["kcam matrix, 512 samples", dtype] < error["kcam matrix, its own samples", dtype] / 10


def test_an_absent_peer_is_skipped_with_a_line():
    console = Console(record=True, width=200)
    versions, skipped = peers.find_peers(console, ("no_such_optics", "rich"))
    assert versions.keys() == {"rich"}
    assert "No module named 'no_such_optics'" in skipped["no_such_optics"]
    assert "no_such_optics is skipped" in console.export_text()


@pytest.mark.parametrize("case", [peers.QUICK, replace(peers.QUICK, vergence=1.0)])
def test_the_truth_is_the_diffraction_integral_in_two_dimensions(case):
    x = oracles.pixel_centres(case.window, case.pitch)
    image = oracles.fresnel_image(
        x,
        x,
        aperture_radius=case.diameter / 2,
        sensor_distance=case.distance,
        wavelength=peers.WAVELENGTH,
        opd=lambda u, v: case.residual(u**2 + v**2),
    )
    torch.testing.assert_close(peers.truth(case), torch.from_numpy(image) * case.pitch**2, rtol=1e-9, atol=1e-14)


@pytest.mark.slow
def test_hard_cases_of_kcam_end_in_the_right_picture_or_an_error():
    rows = peers.hard_rows([])
    assert len({row["case"] for row in rows}) == 5
    for row in rows:
        if row["case"] == "zero aperture" or "512 samples" in row["how"]:
            assert row["outcome"] == "raises"
            assert row["message"].startswith("ValueError")
        else:
            assert row["outcome"] == "finite"
            # float32 keeps 4e-7 of each picture; the angular spectrum's sampled rim costs 6e-4 at this pitch
            assert row["l1"] < (1e-3 if row["how"] == "angular_spectrum" else 2e-6), row
            assert row["energy"] == pytest.approx(row["true_energy"], rel=1e-3)


@pytest.mark.parametrize(
    ("picture", "found"),
    [([1.0, 3.0], "finite"), ([1.0, math.nan], "NaN"), ([1.0, math.inf], "NaN"), (None, "raises")],
)
def test_what_came_of_a_hard_case_is_said(picture, found):
    def prepare() -> tuple:
        if picture is None:
            raise ArithmeticError("no light")
        warnings.warn("thin ice", stacklevel=1)
        return (lambda: torch.tensor(picture)), 0.5

    row = peers.outcome(prepare, torch.tensor([1.0, 1.0], dtype=torch.float64))
    assert row["outcome"] == found
    assert row["energy"] == (2.0 if found == "finite" else None)
    assert row["l1"] == (0.5 if found == "finite" else None)
    assert row["message"] == ("ArithmeticError: no light" if picture is None else None)
    assert row["warnings"] == ([] if picture is None else ["UserWarning: thin ice"])


# ---- camera augmentations ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def augmented(tmp_path_factory: pytest.TempPathFactory) -> dict:
    path = tmp_path_factory.mktemp("augmentation") / "augmentation.json"
    assert augmentation.main(["--quick", "--out", str(path)]) == 0
    return json.loads(path.read_text())


@pytest.mark.slow
def test_every_augmentation_is_raced_on_pictures_and_cubes(augmented):
    names = {name for name in KC.__all__ if name.startswith("Random")}
    for channels, without in ((3, set()), (28, {"RandomColourMatrix", "RandomLens"})):
        lines = {line["augmentation"]: line for line in augmented["lines"] if line["channels"] == channels}
        assert lines.keys() == (names - without) | {"RandomShotReadNoise, normal"}
        for name, line in lines.items():
            assert {"straightforward", "kcam 1", "kcam simulate 1", "identity 1"} <= line["seconds"].keys()
            assert all(seconds > 0 for seconds in line["seconds"].values())
            assert ("0.5" in line["added"]) == (channels == 3 or name not in {"RandomBayer", "RandomCamera"})


@pytest.mark.slow
def test_the_straightforward_way_gives_the_same_picture(augmented):
    exact = [line for line in augmented["lines"] if line["difference"] is not None]
    # what is drawn from the generator (noise, pattern, the camera) is not compared; two take no cubes
    assert len(exact) == 2 * 14 - 2
    for line in exact:
        # measured 6e-6: float32 and the PSFs' sampling, each promised to 1e-4 or better; 0 for most
        assert line["difference"] < 5e-5, line["augmentation"]


@pytest.mark.slow
def test_aims_runs_and_the_pipeline_are_written_down(augmented):
    names = {line["augmentation"] for line in augmented["lines"]}
    assert {aim["what"] for aim in augmented["aims"]} <= names
    assert all(aim["met"] == (aim["ratio"] <= aim["most"]) for aim in augmented["aims"])
    assert [line["count"] for line in augmented["run"]] == [1, 2, 3, 4]
    assert augmented["pipeline"]["seconds_per_batch"].keys() == {"kcam", "Kornia"}
    assert len(augmented["pipeline"]["stages"]) == 8


def test_a_target_may_be_beside_another_contestant():
    rows = [
        {"op": "cube", "direction": "forward", "who": who, "seconds": seconds, "default": who == "kcam", "ratio": 3.0,
         "error": {"relative_max": 1e-7}, "error_ratio": None}
        for who, seconds in (("textbook", 3.0), ("kcam", 1.2), ("floor", 1.0))
    ]  # fmt: skip
    (found,) = bench.Target("", "cube", 1 / 1.3, than="floor").judge(rows)
    assert found["met"]
    assert found["ratio"] == pytest.approx(1 / 1.2)
    assert not bench.Target("", "cube", 1 / 1.1, than="floor").judge(rows)[0]["met"]
    assert bench.Target("", "cube", 2.0, who="nobody").judge(rows) == []
    assert bench.Target("", "cube", 2.0, direction="backward").judge(rows) == []


@pytest.mark.parametrize(
    ("whole", "met", "without_light"), [(13.5, True, False), (8.5, True, True), (29.0, False, False)]
)
def test_what_we_add_is_beyond_identity_and_maths(whole, met, without_light):
    seconds = {"kcam 1": whole, "kcam simulate 1": 4.0, "identity 1": 1.0, "light": 5.0}
    found = augmentation.added({who: {"seconds": value} for who, value in seconds.items()}, 1.0)
    assert found["seconds"] == pytest.approx(whole - 10.0)
    assert found["maths"] == 9.0
    assert (found["met"], found["met_without_light"]) == (met, without_light)


def test_half_of_the_rows_are_drawn_at_one_half():
    for batch in (2, 8):
        torch.manual_seed(augmentation.half_of_the_rows(batch))
        params = KC.RandomDefocus(p=0.5).forward_parameters(torch.Size((batch, 3, 8, 8)))
        assert int(params["batch_prob"].sum()) == batch // 2


# ---- patch stores --------------------------------------------------------------------------------------------------


def test_patch_stores_are_timed_side_by_side(tmp_path):
    assert patch_stores.main(["--quick", "--out", str(tmp_path / "patches.json"), "--folder", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "patches.json").read_text())
    assert content["patches"] == 2 * 25
    rows = {(row["store"], row["state"]): row for row in content["reading"]}
    assert {store for store, _ in rows} == set(patch_stores.STORES)
    for (store, state), row in rows.items():
        if state == "skipped":
            assert store in ("HDF5", "Zarr")
            continue
        assert row["patches_per_second"] > 0
        assert row["rounds"] == 2
        assert row["kcam_is_faster"] == 1 or store != "kcam store"
    assert [row["what"] for row in content["extraction"]] == ["extract", "copy"]
    assert all(row["MB_per_second"] > 0 for row in content["extraction"])
    assert content["extraction"][0]["bytes"] == 2 * (25 * 4 * 32 * 32 * 2 + 128)
    assert [path.name for path in tmp_path.iterdir()] == ["patches.json"]


# ---- a training step of preset thesis ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def step() -> style_step.Bench:
    return style_step.Bench(style_step.QUICK)


def loss_of(bench: style_step.Bench, take) -> dict[str, float]:
    with torch.no_grad():
        picture, recorded = take(bench.scene)
        terms = bench.loss.terms(picture, bench.shown, recorded=recorded)
    return bench.loss_error({name: float(term) for name, term in terms.items()})


def check_against_unfused(bench: style_step.Bench) -> None:
    """kcam's step as training runs it: the loss and the gradients of the unfused float64 path."""
    camera = bench.cameras[True]
    gradients, terms = bench.whole_step(camera, lambda: style_step.kcam_picture(camera, bench.scene))
    assert bench.loss_error(terms)["loss"] < 1e-4  # what issue 8 asks; 4e-8 at toy sizes, float32 against float64
    assert gradients.keys() == {"DOE", "filter", "convolution"}
    for name, error in bench.errors(gradients, bench.truth["whole"]).items():
        # measured 1e-6 relative in float32; a lost band, a turned PSF or a detached path is off by tenths
        assert error < 1e-3, name


def test_the_cubes_of_a_step_have_no_factors(step):
    assert step.scene.spectra is None
    bands = step.scene.bands().transpose(0, 1).flatten(1).double()
    values = torch.linalg.svdvals(bands)
    assert values[-1] > 1e-2 * values[0]  # without texture: three spectra, and 1e-7


def test_a_step_has_the_loss_of_the_unfused_float64_path(step):
    check_against_unfused(step)


@pytest.mark.slow
def test_a_step_of_the_real_sizes_has_the_loss_of_the_unfused_float64_path():
    check_against_unfused(style_step.Bench(style_step.Sizes()))


@pytest.mark.slow
def test_a_finely_sampled_textbook_comes_to_the_loss_of_a_step(step):
    camera = copy.deepcopy(step.cameras[True])
    as_timed = loss_of(step, style_step.Textbook(camera, step.sizes, oversample=2))
    doe = style_step.doe_of(camera)
    # the same DOE, each pixel sampled 4 x 4 times: light beyond one sample's diffraction and the rim's staircase
    doe.phase = torch.nn.Parameter(doe.phase.detach().repeat_interleave(4, 0).repeat_interleave(4, 1))
    finer = loss_of(step, style_step.Textbook(camera, step.sizes, oversample=4))
    assert finer["loss"] < 1e-4  # measured 1.6e-5; 3e-6 with 8 x 8 and 6 x 6 a sensor's pixel
    assert finer["loss, l2"] < 1.5e-3  # measured 4.6e-4: a small difference of two signals
    assert as_timed["loss"] > 5 * finer["loss"]  # measured 1.3e-3: what is timed is the coarser one


@pytest.mark.slow
def test_a_step_is_raced_in_parts_and_whole(tmp_path):
    assert style_step.main(["--quick", "--out", str(tmp_path / "step.json")]) == 0
    content = json.loads((tmp_path / "step.json").read_text())
    races = {}
    for row in content["rows"]:
        races.setdefault((row["op"], row["direction"]), []).append(row)
        assert row["seconds"] > 0
        assert all(math.isfinite(value) for value in row["error"].values())
    assert len(races) == 2 * 2 + 1
    for rows in races.values():
        assert rows[0]["baseline"]
        of_points = rows[0]["op"].endswith("points")
        assert [row["who"] for row in rows if row["default"]] == ["kcam, points" if of_points else "kcam"]
        assert all(row["error"]["relative_max"] < 1e-5 for row in rows if row["default"] and "camera" in row["op"])
    whole = {row["who"]: row["error"]["loss"] for row in content["rows"] if "loss" in row["error"]}
    # measured 4e-8, 1.3e-3 and 2.8e-3: a staircase rim, and point samples in place of the light in the pixels
    assert 100 * whole["kcam"] < whole[style_step.SPARED_PIXELS] < whole["textbook, points"]
    assert content["targets"] == content["projected"] == []


@pytest.mark.parametrize(
    ("ratio", "loss", "met"),
    [(6.1, 1e-5, [True, True, True]), (5.9, 2e-4, [True, False, False]), (2.9, 1e-5, [False, False, True])],
)
def test_a_step_is_judged_as_issue_8_asks(ratio, loss, met):
    """By time against fields of complex128, which take twice as long here, of complex64, and by the loss."""
    common = {"direction": "forward", "who": "kcam", "error_ratio": None, "default": True, "ratio": ratio}
    camera = common | {"op": "preset thesis: camera, textbook by points", "error": {}, "dtype": "float32"}
    step = common | {"op": "preset thesis: whole step", "error": {"loss": loss}, "dtype": "float32"}
    double = {"default": False, "who": style_step.DOUBLE_POINTS, "dtype": "complex128", "ratio": 0.5}
    elsewhere = double | {"direction": "forward + backward", "ratio": 0.01}
    rows = [camera, step, camera | double, step | double, camera | elsewhere]
    rows += [row | {"default": False, "who": "textbook"} for row in (camera, step)]
    verdicts = style_step.verdicts_of(rows)
    assert [verdict["met"] for verdict in verdicts] == met
    assert [verdict["ratio"] for verdict in verdicts] == pytest.approx([2 * ratio, ratio, ratio])


def test_fifty_epochs_of_kaist_are_projected_from_a_step():
    (row,) = style_step.projected([{"who": "kcam", "seconds": 3.6}])
    assert row["steps"] == 50 * 1950  # 3900 patches, two in a step
    assert row["hours"] == pytest.approx(97.5)


# ---- over the field ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_pictures_over_the_field_beside_patches_and_eigen_psfs(tmp_path: Path) -> None:
    path = tmp_path / "field.json"
    arguments = ["--quick", "--cameras", "slr", "--out", str(path)]
    assert over_field.main([*arguments, "--only", "methods,gradient"]) == 0
    before = json.loads(path.read_text())["rows"]
    photograph = {row["who"]: row for row in before if row["part"] == "methods" and row["scene"] == "photograph"}
    assert set(over_field.BASELINES) < set(photograph)
    # kcam spends its error up to 60 dB; so near the axis of a 50 mm at f/4 PSFs hardly vary, but the picture is bent
    assert photograph["kcam"]["psnr_worst"] > 60
    plain = photograph.pop("one PSF, nothing moved or darkened")
    assert all(row["psnr"] > plain["psnr"] + 3 for row in photograph.values() if "psnr" in row)
    assert all(row["finite"] and row["curvatures"] > 8 for row in before if row["part"] == "gradient")
    assert over_field.main([*arguments, "--only", "pictures"]) == 0
    after = json.loads(path.read_text())["rows"]
    assert [row for row in after if row["part"] != "pictures"] == before


def test_a_row_that_is_measured_again_takes_its_place() -> None:
    rows: list[dict] = []
    for seconds, part, size in ((1, "methods", [4, 6]), (2, "pictures", [40, 60]), (3, "pictures", [4, 6])):
        rows = over_field.merged(
            rows, {"part": part, "camera": "slr", "scene": "stars", "size": size, "who": "kcam", "first": seconds}
        )
    again = rows[0] | {"first": 4}
    assert [row["first"] for row in over_field.merged(rows, again)] == [4, 2, 1]


# ---- against an earlier version ------------------------------------------------------------------------------------


class Version:
    """A process that stops at one race, and takes so long for it in each round."""

    def __init__(self, op: str, times: list[float]) -> None:
        self.answers, self.times, self.stdin = [{"op": op}], itertools.cycle(times), self

    def write(self, text: str) -> None:
        if text.strip() == "go":
            self.answers.append(next(self.times))
        elif text.strip() == "on":
            self.answers.append(None)

    def flush(self) -> None: ...


@pytest.mark.parametrize(
    ("again", "own", "lost"),
    [
        ([1.0, 1.0, 1.0], [1.02, 1.02, 1.02], False),
        ([1.0, 1.0, 1.0], [1.04, 1.05, 0.5], True),
        ([1.1, 0.9, 1.0], [1.1, 1.1, 1.1], False),  # as far as the earlier version is from itself
        ([1.1, 0.9, 1.0], [1.2, 1.2, 1.2], True),
    ],
)
def test_a_race_is_lost_beyond_three_percent_and_the_spread(monkeypatch, again, own, lost) -> None:
    monkeypatch.setattr(against, "told", lambda process: process.answers.pop(0))
    versions = [Version("psf", times) for times in ([1.0, 1.0, 1.0], again, own)]
    (row,) = against.raced(versions, rounds=3)
    assert row["lost"] == lost
    assert row["seconds"]["this"] == sorted(own)[1]


def test_versions_that_race_differently_are_not_compared(monkeypatch) -> None:
    monkeypatch.setattr(against, "told", lambda process: process.answers.pop(0))
    with pytest.raises(RuntimeError, match="race differently"):
        next(against.raced([Version(op, []) for op in ("psf", "psf", "render")], rounds=1))


def test_nothing_is_slower_than_in_the_version_before() -> None:
    """As measured and committed."""
    rows = json.loads(against.RESULTS.read_text())["rows"]
    assert len(rows) >= 30
    assert [row["op"] for row in rows if row["ratio"] > 1 + against.ALLOWED + row["spread"]] == []


@pytest.mark.parametrize(
    "part", ["augmentations", *(pytest.param(part, marks=pytest.mark.slow) for part in ("pictures", "styles"))]
)
def test_the_gpus_parts_run_on_the_cpu(part: str, tmp_path: Path) -> None:
    out = tmp_path / "gpu.json"
    out.write_text(json.dumps({"other": [{"gpu": 1.0}]}))
    assert gpu.main(["--device", "cpu", "--quick", "--only", part, "--out", str(out)]) == 0
    content = json.loads(out.read_text())
    assert content["other"] == [{"gpu": 1.0}]  # what was measured before stays
    rows = content[part]["rows"]
    assert all(row["gpu"] > 0 and row["gpu_calls"] in (1, gpu.ROUNDS) for row in rows)
    if part == "pictures":
        assert within_tolerance(rows)


def test_a_part_that_fails_leaves_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(device: torch.device, quick: bool) -> list[dict]:
        raise RuntimeError("no GPU any more")

    monkeypatch.setitem(gpu.MEASURED, "styles", fails)
    out = tmp_path / "gpu.json"
    out.write_text(json.dumps({"styles": [{"gpu": 1.0}]}))
    assert gpu.main(["--device", "cpu", "--quick", "--only", "styles,augmentations", "--out", str(out)]) == 1
    content = json.loads(out.read_text())
    assert content["styles"] == [{"gpu": 1.0}]
    assert content["augmentations"]["rows"]


def within_tolerance(rows: list[dict]) -> bool:
    planned = [row for row in rows if row["plan"] != "reference"]
    return bool(planned) and all(row["error"] <= float(row["plan"].split()[-1]) for row in planned)


def test_plans_kept_their_tolerance_on_a_gpu() -> None:
    rows = json.loads(gpu.RESULTS.read_text())["pictures"]["rows"]
    assert within_tolerance(rows)
    assert all(row["error"] < 1e-6 for row in rows if row["plan"] == "reference")  # of the CPU's

"""Damaged metadata in every kind of file: ValueError with the file's name, or what the file says. See `damage.py`."""

from __future__ import annotations

import random
import shutil
from collections import Counter
from pathlib import Path

import damage
import pytest
from damage import KINDS, Kind

from kcam import files
from kcam.planner import costs


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A whole file of each kind, in a folder of its own."""
    return {name: kind.make(tmp_path_factory.mktemp("made")) for name, kind in KINDS.items()}


def outcome(kind: Kind, whole: Path, folder: Path, text: str) -> str:
    """ "read" or "refused" of a copy that says something else; AssertionError for any other end."""
    top = whole
    while not top.parent.name.startswith("made"):
        top = top.parent
    place = folder / "copy"
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(top.parent, place)
    path = place / whole.relative_to(top.parent)
    kind.put(path, text)
    try:
        kind.read(path)
    except ValueError as error:
        if kind.named(path) not in str(error):
            raise AssertionError(f"{error!r} does not name {kind.named(path)}") from error
        return "refused"
    return "read"


@pytest.mark.parametrize("name", KINDS)
def test_whole_files_are_read(name: str, made: dict[str, Path], tmp_path: Path) -> None:
    kind = KINDS[name]
    text = damage.json.dumps(kind.take(made[name]))
    assert outcome(kind, made[name], tmp_path, text) == "read"


def campaign(name: str, whole: Path, folder: Path, seeds: range) -> Counter[str]:
    kind, outcomes, problems = KINDS[name], Counter[str](), []
    document = kind.take(whole)
    for seed in seeds:
        rng = random.Random(f"{name} {seed}")
        damage_of = damage.damaged if seed % 4 else lambda d, r: damage.torn(damage.json.dumps(d), r)
        text = damage_of(document, rng)
        try:
            outcomes[outcome(kind, whole, folder, text)] += 1
        except Exception as error:
            problems.append(f"{name} {seed}: {type(error).__name__}: {error}"[:500])
    assert not problems, "\n".join([f"{len(problems)} of {len(seeds)}", *problems[:10]])
    return outcomes


@pytest.mark.parametrize("name", KINDS)
def test_damaged_metadata_is_refused_by_the_name_of_its_file(name: str, made: dict[str, Path], tmp_path: Path) -> None:
    campaign(name, made[name], tmp_path, range(8))


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_much_damaged_metadata_is_refused_by_the_name_of_its_file(
    name: str, made: dict[str, Path], tmp_path: Path
) -> None:
    outcomes = campaign(name, made[name], tmp_path, range(8, 408))
    assert outcomes["refused"] > 100 or name == "scene done"


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_flipped_bytes_end_in_an_error_with_the_name_of_the_file(
    name: str, made: dict[str, Path], tmp_path: Path
) -> None:
    """In the file itself, its header and its values: what is read is whole, or refused."""
    kind = KINDS[name]
    for seed in range(60):
        rng = random.Random(f"{name} bytes {seed}")

        def put(path: Path, text: str, rng: random.Random = rng) -> None:
            held = bytearray(path.read_bytes())
            for _ in range(rng.choice([1, 3, 20])):
                held[int(rng.random() ** 3 * len(held))] = rng.randrange(256)
            path.write_bytes(held[: rng.choice([len(held), len(held), rng.randrange(len(held))])])

        outcome(Kind(kind.make, kind.take, put, kind.read, kind.named), made[name], tmp_path, "")


@pytest.mark.parametrize(
    "text", ["", "[]", "5", '{"rates": 5}', '{"rates": []}', damage.DEEP, '{"rates": {"fft": "x"}}']
)
def test_damaged_rates_count_as_none(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KCAM_CACHE", str(tmp_path))
    costs.rates_path().write_text(text)
    assert costs.current_rates() == costs.RATES
    costs.rates_path().write_text('{"rates": {"fft": 1' + "0" * 400 + "}}")
    assert costs.current_rates() == costs.RATES


@pytest.mark.parametrize("key", ["format", "kcam", "configuration", "aliases", "state"])
def test_a_camera_without_one_of_its_keys_is_refused(key: str, made: dict[str, Path], tmp_path: Path) -> None:
    document = damage._metadata(made["camera 1"])
    del document[key]
    path = shutil.copy(made["camera 1"], tmp_path / "camera.safetensors")
    damage._put_metadata(path, damage.json.dumps(document))
    for read in (damage.Camera.load, files.describe):
        with pytest.raises(ValueError, match=rf"camera.safetensors is damaged, or no camera: it has no '{key}'. Save"):
            read(path)

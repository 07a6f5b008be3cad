"""Model cards: what is written beside a trained camera, and into a folder for a hub."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from kcam import card
from kcam.card import Card


def told(**changes) -> Card:
    how = {
        "title": "A camera for night",
        "style": "night | day.png",
        "licence": "CC0-1.0",
        "facts": [("steps", "3"), ("scenes", "a|b\n<c>\\|")],
        "measures": [("what", "before", "after"), ("loss: style", "0.9", "0.1")],
        "notes": ["A note."],
    }
    return Card(**(how | changes))


@pytest.mark.parametrize(
    "licence", ["CC0-1.0", "MIT", "CC BY 4.0: mine", '"no": quotes', "[a list]", "-", "no", "\x7f", None]
)
def test_the_head_is_yaml_of_a_licence_that_hubs_know(licence: str | None) -> None:
    yaml = pytest.importorskip("yaml")  # of the documentation's tools
    text = told(licence=licence).text("night.safetensors", {})
    head = yaml.safe_load(text.split("---\n")[1])
    assert head["library_name"] == "kcam"
    assert head["license"] in (*card.LICENCES, "other")
    assert head.get("license_name", head["license"]) == (licence or "unknown").lower()
    assert ("Say whose it is before you pass this camera on" in text) == (licence is None)


def test_what_it_says_of_the_painting() -> None:
    assert "holds all of it" in told(holds=True).text("a.safetensors", {})
    assert "holds all of it" not in told().text("a.safetensors", {})


def test_tables_stay_tables_and_names_are_quoted() -> None:
    text = told().text("my night's.safetensors", {"sheet.png": "my night/sheet.png", "loss.png": "loss.png"})
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert [len(re.findall(r"(?<!\\)\|", row)) for row in rows] == [3] * 4 + [4] * 3
    assert "(my%20night/sheet.png)" in text
    assert "--camera 'my night'\"'\"'s.safetensors' --out" in text
    assert 'Camera.load("my night\'s.safetensors")' in text
    assert text.endswith("A note.\n")


def test_a_folder_for_a_hub_holds_no_more_than_it_says(tmp_path: Path) -> None:
    camera, run, folder = tmp_path / "night.safetensors", tmp_path / "night", tmp_path / "hub" / "night"
    camera.write_bytes(b"camera")
    run.mkdir()
    (run / "sheet.png").write_bytes(b"picture")
    (run / "config.json").write_text(f'"{tmp_path}"')
    card.write_folder(told(), camera, run, folder)
    assert {path.name for path in folder.iterdir()} == {"README.md", "night.safetensors", "sheet.png"}
    assert (folder / "night.safetensors").read_bytes() == b"camera"
    assert "(sheet.png)" in (folder / "README.md").read_text()
    card.write_folder(told(title="Another"), camera, run, folder)
    assert "# Another" in (folder / "README.md").read_text()
    assert "(night/sheet.png)" in card.write(told(), camera, run).read_text()


def test_nothing_that_is_no_card_is_replaced(tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("# My project")
    run = tmp_path / "run"
    with pytest.raises(ValueError, match=r"README.md is no model card of kcam's, and would be lost"):
        card.check_folder(tmp_path, run=run)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "sheet.png").write_text("mine")
    with pytest.raises(ValueError, match=r"holds files and no card of kcam's: expected a new or an empty folder"):
        card.check_folder(tmp_path / "other", run=run)
    for own in (run, run / "hub"):
        with pytest.raises(ValueError, match=r"is the run's own folder"):
            card.check_folder(own, run=run)
    with pytest.raises(ValueError, match=r"README.md/hub cannot be made: .*Choose another folder"):
        card.check_folder(readme / "hub", run=run)
    with pytest.raises(ValueError, match=r"would be lost"):
        card.write(told(), tmp_path / "README.safetensors", tmp_path)
    assert readme.read_text() == "# My project"
    with pytest.raises(ValueError, match=r"README.md is a file: expected a folder"):
        card.check_folder(readme, run=run)

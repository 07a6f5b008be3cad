"""One contract for every hard case: finite, float32 close to float64, the right limit; or a clear error."""

from __future__ import annotations

import pytest
import torch
from cases import BAD_CASES, CASES, ITEMS, NAMES
from contract import DOUBLE, SINGLE, BadCase, Case, photograph, relative

QUICK = 3  # of so many cases, one runs among the quick tests
ROWS = [
    pytest.param(case, id=case.name, marks=[pytest.mark.slow] if case.slow or index % QUICK else [])
    for index, case in enumerate(CASES)
]


@pytest.mark.parametrize("case", ROWS)
def test_hard_case(case: Case, dtype: torch.dtype, device: torch.device) -> None:
    shot = photograph(case, dtype, device)
    for name, signal in (*shot.signals.items(), ("raw", shot.raw), ("picture", shot.picture)):
        assert signal.isfinite().all(), f"{name} is not finite"
    for gradients in (shot.noisy_gradients, shot.gradients):
        assert "scene" in gradients
        for name, gradient in gradients.items():
            assert gradient.isfinite().all(), f"gradient of {name} is not finite"
    if case.warns is None:
        assert not shot.warnings
    else:
        assert any(case.warns in message for message in shot.warnings), shot.warnings
    if dtype == SINGLE:
        truth = photograph(case, DOUBLE, device)
        dark = 1e-7 * truth.raw.numel() ** 0.5  # where light is less than float32's step at full scale
        measured = {"raw": relative(shot.raw, truth.raw, least=dark), "picture": relative(shot.picture, truth.picture)}
        for name, gradient in truth.gradients.items():
            measured[f"gradient of {name}"] = relative(shot.gradients[name], gradient, least=truth.least.get(name, 0.0))
        print("float32 against float64:", ", ".join(f"{name} {value:.1e}" for name, value in measured.items()))
        for name, value in measured.items():
            assert value <= (case.gradients if name.startswith("gradient") else case.values), name
    if case.limit is not None:
        case.limit(shot)


@pytest.mark.parametrize("case", BAD_CASES, ids=lambda case: case.name)
def test_bad_input_is_refused(case: BadCase) -> None:
    with pytest.raises(case.error) as caught:
        case.attempt()
    for part in (case.value, case.expected, case.fix):
        assert part in str(caught.value)


def test_every_item_of_the_list_has_its_cases() -> None:
    """Issue 4, "Hard cases": at least 60 cases, and each thing that it names is there by name."""
    rows = [*CASES, *BAD_CASES]
    assert len(rows) >= 60
    assert len(set(NAMES)) == len(rows)
    assert {row.item for row in rows} == set(ITEMS)
    for case in CASES:
        usual = case.values <= Case.values and case.gradients <= Case.gradients
        assert usual or case.reason, f"{case.name} widens a bound without a reason"

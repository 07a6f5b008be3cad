"""Values of before: each question of `golden.questions` still has the answer that commit 6be9aaf gave;
of plans since that are made from spectra, that of the commit which made them so.

A tensor may be 1e-6 of its norm off in float32 and 1e-12 in float64, times the factor that `golden.rounding` gives.
Where an answer is meant to change, ``PYTHONPATH=tests python -m golden.record`` records new ones of the questions whose
entries were taken out of values.json, and the commit says why.
"""

from __future__ import annotations

import json

import pytest
import torch
from golden.digest import PROJECTIONS, differences, digest, relative_difference, signs
from golden.question import Question, Scaled
from golden.questions import QUESTIONS
from golden.record import VALUES, answered
from golden.rounding import factor

QUICK = 6  # every sixth question is asked by `make test`, all of them by `make test-all`


@pytest.fixture(scope="module")
def recorded() -> dict[str, dict]:
    return json.loads(VALUES.read_text())


def test_every_question_has_a_recorded_answer(recorded):
    assert sorted(recorded) == sorted(QUESTIONS)


@pytest.mark.parametrize(
    "question",
    [
        pytest.param(question, id=question.name, marks=[pytest.mark.slow] if question.slow or index % QUICK else [])
        for index, question in enumerate(QUESTIONS.values())
    ],
)
def test_the_answer_is_that_of_before(question: Question, recorded):
    kept, found = recorded[question.name], answered(question)
    assert found.keys() == kept.keys(), question.name
    wrong = []
    for name in kept:
        allowed = factor(question.name, name)
        off = differences(kept[name], found[name], name)
        wrong += [f"{text}, {times / allowed:.3g} times what is allowed" for times, text in off if times > allowed]
    assert not wrong, f"{question.name}:\n" + "\n".join(wrong)


# ---- the comparison itself -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [5, 24, 25, 3000])
@pytest.mark.parametrize("where", ["one value", "all values", "their sum"])
def test_a_difference_is_seen_wherever_it_lies(count, where, generator):
    values = torch.randn(count, generator=generator, dtype=torch.float64)
    change = torch.zeros(count, dtype=torch.float64)
    if where == "one value":
        change[count // 3] = 1.0
    else:
        change = torch.ones(count, dtype=torch.float64) if where == "their sum" else -values
    change *= 1e-9 * values.norm() / change.norm()
    off = relative_difference(digest(values), digest(values + change))
    assert 0.6e-9 < off < 1.6e-9


def told(kept, found) -> list[str]:
    return [text for times, text in differences(digest(kept), digest(found)) if times > 1]


def test_a_difference_names_what_and_how_much():
    assert told({"psf": torch.ones(3)}, {"psf": torch.tensor([1.0, 1.0, 1.1])}) == [
        "psf: float32, 5.8e-02 of its norm 1.732 off"
    ]
    assert told({"rows": [1, "a"]}, {"rows": [1, "b"]}) == ["rows[1]: was 'a', is 'b'"]
    assert told({"rows": [1]}, {"rows": [1, 2]}) == ["rows: was [1], is [1, 2]"]
    assert told({"error": 1e-3}, {"error": 1.1e-3}) == ["error: was 0.001, is 0.0011, 1.0e-01 of it off"]
    assert told({"psf": torch.ones(4)}, {"psf": torch.ones(2, 2)}) == ["psf: shape was [4], is [2, 2]"]
    assert told({"psf": torch.ones(4)}, {"psf": torch.ones(4).double()}) == ["psf: dtype was float32, is float64"]


@pytest.mark.parametrize("count", [9, 100])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_a_difference(value, count):
    plain = torch.ones(count)
    broken = plain.clone()
    broken[7] = value
    assert told(plain, broken)
    assert told(broken, plain)
    assert not told(broken, broken)
    assert told({"error": 1.0}, {"error": value})


def test_a_scale_of_its_own_counts_where_it_is_larger():
    kept, found = torch.tensor(1.0), torch.tensor(1.001)
    assert told(Scaled(kept, 0.1), Scaled(found, 0.1))
    assert not told(Scaled(kept, 1e4), Scaled(found, 1e4))


def test_the_signs_are_the_same_on_every_machine():
    assert signs(70).shape == (PROJECTIONS, 70)
    assert "".join("+" if sign > 0 else "-" for sign in signs(70)[0, :12]) == "-----+--++-+"

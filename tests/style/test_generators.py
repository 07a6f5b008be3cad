from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from kcam.style.generators import philox, torch_generator

COUNT = 4096
BOUND = 5 / COUNT**0.5  # 5 sigma of the correlation of two independent sequences of that length
MASK = 2**64 - 1


def philox_block(key: tuple[int, int], counter: tuple[int, int, int, int]) -> list[int]:
    """Philox 4x64-10 as its paper has it: ten rounds of two products and the key."""
    c, (k0, k1) = list(counter), key
    for _ in range(10):
        p0, p1 = 0xD2E7470EE14C6C93 * c[0], 0xCA5A826395121157 * c[2]
        c = [p1 >> 64 ^ c[1] ^ k0, p1 & MASK, p0 >> 64 ^ c[3] ^ k1, p0 & MASK]
        k0, k1 = k0 + 0x9E3779B97F4A7C15 & MASK, k1 + 0xBB67AE8584CAA73B & MASK
    return c


def test_oracle_gives_the_known_answer():
    """Random123's kat_vectors, philox4x64 10 rounds, all zeros."""
    expected = [0x16554D9ECA36314C, 0xDB20FE9D672D0FDC, 0xD7E772CEE186176B, 0x7E68B68AEC7BA23B]
    assert philox_block((0, 0), (0, 0, 0, 0)) == expected


@pytest.mark.parametrize(("seed", "step", "stream"), [(0, 0, 0), (1, 2, 3), (2**63 - 1, 2**63 - 2, 2**63 - 3)])
def test_bits_are_those_of_the_paper(seed: int, step: int, stream: int):
    """The key is (seed, stream), the step the counter's top word; numpy counts the blocks from 1 in the lowest."""
    expected = [word for block in (1, 2) for word in philox_block((seed, stream), (block, 0, 0, step))]
    assert philox(seed, step, stream=stream).bit_generator.random_raw(8).tolist() == expected


def test_first_values_are_pinned():
    """What numpy and torch make of the bits: if a release changes it, a resumed run is another run."""
    assert philox(0, 0).random(2).tolist() == [0.011546754286331562, 0.24154919656271812]
    assert philox(1, 2, stream=3).random(2).tolist() == [0.0925885790718205, 0.4149406683860519]
    assert philox(1, 2, stream=3).integers(1000, size=4).tolist() == [96, 92, 498, 414]
    assert philox(1, 2, stream=3).permutation(6).tolist() == [5, 2, 1, 4, 0, 3]
    # the last bits of a normal are the mathematics library's
    assert philox(1, 2, stream=3).standard_normal(2) == pytest.approx([-1.2773235217761236, 0.4519562345586356], 1e-12)
    generator = torch_generator(1, 2, stream=3)
    assert generator.initial_seed() == 6517340584967227835
    assert torch.randint(1000, (3,), generator=generator).tolist() == [275, 223, 561]


def numbers(kind: str, *key: int) -> np.ndarray:
    seed, step, stream = key
    if kind == "numpy":
        return philox(seed, step, stream=stream).standard_normal(COUNT)
    return torch.randn(COUNT, generator=torch_generator(seed, step, stream=stream), dtype=torch.float64).numpy()


KEYS = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (0, 2, 0)]
KEYS += [(0, 2**32 - 1, 1), (2**32, 0, 0), (0, 0, 2**32)]


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_sequences_do_not_know_of_each_other(kind: str):
    rows = np.stack([numbers(kind, *key) for key in KEYS])
    correlation = np.corrcoef(rows) - np.eye(len(KEYS))
    assert abs(correlation).max() < BOUND
    # nor is one the other, moved along
    for one in rows:
        assert np.isin(one, rows).sum() == COUNT
    assert len(np.unique(rows)) == rows.size


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_what_came_before_does_not_matter(kind: str):
    forwards = [numbers(kind, *key) for key in KEYS]
    np.random.seed(1)
    torch.manual_seed(1)
    backwards = [numbers(kind, *key) for key in reversed(KEYS)][::-1]
    assert all(np.array_equal(one, two) for one, two in zip(forwards, backwards, strict=True))


def test_global_random_state_is_left_alone():
    before, torch_before = np.random.get_state()[1].copy(), torch.get_rng_state()
    philox(1, 2).random(3)
    torch.rand(3, generator=torch_generator(1, 2))
    assert np.array_equal(before, np.random.get_state()[1])
    assert torch.equal(torch_before, torch.get_rng_state())


def test_two_steps_never_share_the_seed_that_torch_reads():
    """The low 32 bits: drawn at random, 50 000 of them would hold 0.3 pairs on average; counted, they hold none."""
    seeds = {torch_generator(7, step).initial_seed() % 2**32 for step in range(50_000)}
    assert len(seeds) == 50_000


def test_torch_on_a_device(hardware: torch.device):
    one, two = (torch.rand(8, generator=torch_generator(3, 4, device=hardware), device=hardware) for _ in range(2))
    assert torch_generator(3, 4, device=hardware).device.type == hardware.type
    assert torch.equal(one, two)


def test_numpy_integers_are_integers():
    assert philox(np.int64(3), np.uint8(4)).random() == philox(3, 4).random()


@pytest.mark.parametrize("value", [-1, 2**63, 1.0, "1", None, True, np.float32(1)])
@pytest.mark.parametrize("name", ["seed", "step", "stream"])
def test_what_is_no_number_of_a_step(name: str, value: object):
    arguments = {"seed": 0, "step": 0, "stream": 0} | {name: value}
    for draw, bits in ((philox, 63), (torch_generator, 32 if name == "step" else 63)):
        message = re.escape(f"{name} must be a whole number from 0 to 2**{bits} - 1, got {value!r}. Use {name}=0, say.")
        with pytest.raises(ValueError, match=message):
            draw(**arguments)

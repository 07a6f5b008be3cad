"""Random numbers that depend on (seed, step, stream) and on nothing else: no state to save, whatever the order.

A training step asks for its own generators, so a run that goes on from step 500 needs the number 500, no more. A stream
is one use within a step (which patch, which crop, which noise): one use that draws more does not move the others.
"""

from __future__ import annotations

import operator

import numpy as np
import torch


def philox(seed: int, step: int, *, stream: int = 0) -> np.random.Generator:
    """The random numbers of one step: Philox 4x64 with the key (seed, stream), and the step in the counter's top word.

    Args:      seed: of the run, 0..2**63-1.
               step: of the run, 0..2**63-1.
               stream: the use within the step, 0..2**63-1.
    Returns:   a new generator at its first number. It has 2**192 blocks until it meets the next step's.
    Raises:    ValueError for a number that is not whole or is outside its range.
    Valid when numpy's methods (integers, random, ...) stay as they are: a numpy release may change what they make of
               the same bits, and does so rarely; the tests pin their first values.
    Source:    Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011.
    """
    key = [_whole("seed", seed), _whole("stream", stream)]
    counter = [0, 0, 0, _whole("step", step)]
    return np.random.Generator(
        np.random.Philox(key=np.array(key, dtype=np.uint64), counter=np.array(counter, dtype=np.uint64))
    )


def torch_generator(seed: int, step: int, *, stream: int = 0, device: torch.device | str = "cpu") -> torch.Generator:
    """A torch generator of its own for each (seed, step, stream), for steps less than 2**32.

    torch's CPU generator reads only the low 32 bits of a seed. Drawn at random, two of 10 000 steps would share them
    in 1 run of 86; so they count the steps, from a start that is drawn: steps of one seed and stream never share them.
    """
    low, high = (int(word) for word in philox(seed, 0, stream=stream).bit_generator.random_raw(2))
    own = (low + _whole("step", step, bits=32)) % 2**32
    return torch.Generator(device).manual_seed((high % 2**31) << 32 | own)


def _whole(name: str, value: int, *, bits: int = 63) -> int:
    try:
        number = -1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = -1
    if not 0 <= number < 2**bits:
        raise ValueError(f"{name} must be a whole number from 0 to 2**{bits} - 1, got {value!r}. Use {name}=0, say.")
    return number

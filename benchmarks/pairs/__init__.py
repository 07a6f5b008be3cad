"""Pairs of camera and scene drawn at random, on which plans are tried: each follows from its seed alone.

Random ones are what users have, `usual`; hard ones what a plan could overlook, `hard`; adversarial ones are through
other optics, `adversarial`; assorted ones through every aperture and with every option, `assorted`; strange ones what
a reader put together who knew nothing of the others, `strange`. Into all of them effects of light and sensor may be
drawn, `effects`. A pair whose reference would take too long is drawn again, and counted.
"""

from benchmarks.pairs.adversarial import adversarial_pair
from benchmarks.pairs.assorted import assorted_pair
from benchmarks.pairs.effects import with_effects
from benchmarks.pairs.hard import hard_pair
from benchmarks.pairs.later import LATER, later_scene
from benchmarks.pairs.parts import LONGEST
from benchmarks.pairs.strange import strange_pair
from benchmarks.pairs.usual import random_pair

FAMILIES = {
    "random": random_pair,
    "hard": hard_pair,
    "adversarial": adversarial_pair,
    "assorted": assorted_pair,
    "strange": strange_pair,
}
"""What draws a pair, by the name of its family."""

__all__ = [
    "FAMILIES",
    "LATER",
    "LONGEST",
    "adversarial_pair",
    "assorted_pair",
    "hard_pair",
    "later_scene",
    "random_pair",
    "strange_pair",
    "with_effects",
]

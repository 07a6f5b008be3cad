"""The pupil plane and its samples."""

from kcam.optics.pupil.coordinates import Pupil

__all__ = ["Pupil"]

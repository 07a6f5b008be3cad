"""Memory that is freed stays with the process, for programs whose pictures are large.

The C library gives large blocks back to the system at once and asks for them anew, and the system clears every page
again: of a picture of 12 megapixels that is a fifth of the time. It is a setting of the whole process, so a library
does not make it unasked; the command `kcam` does.
"""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # malloc.h
_ALWAYS = 2**31 - 1


def keep() -> bool:
    """Keep what is freed, up to the end of the process; whether this could be had: of glibc it can."""
    if not sys.platform.startswith("linux"):
        return False
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is None:
        return False
    return all(set_option(option, _ALWAYS) == 1 for option in (_MMAP_THRESHOLD, _TRIM_THRESHOLD))

"""Memory of the process."""

from __future__ import annotations

import ctypes
import sys

# options of glibc's mallopt, by its numbers: how much free memory at its end goes back to the
# system, and from which size on an array has memory of its own, which goes back once it is freed
# [B]
_KEPT = {-1: 2**28, -3: 2**26}


def keep_freed_memory() -> None:
    """Let the C library keep what is freed for what comes next, where it is glibc.

    Where arrays of some megabytes come and go, the system else clears the same memory over and
    over: a fifth of the time of a design. To be called once, by who owns the process.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for option, size in _KEPT.items():
            mallopt(option, size)

"""Memory of the process."""

from __future__ import annotations

import ctypes
import sys

# options of glibc's mallopt: how much free memory at its end goes back to the system, and from
# which size on an array has memory of its own, which goes back when it is freed [B]
_TRIM, _OWN = -1, -3
_NEVER = 2**30


def keep_freed_memory() -> None:
    """Let the C library keep what is freed for what comes next, where it is glibc.

    Where arrays of some megabytes come and go, the system else clears the same memory over and
    over. The process then holds as much as it ever needed until it ends.
    """
    if sys.platform != "linux":
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for option in (_TRIM, _OWN):
            mallopt(option, _NEVER)

"""What the C library does with memory that is freed."""

from __future__ import annotations

import ctypes
import os
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h
_KEPT_BYTES = 2**30


def keep_freed_memory() -> bool:
    """Let this process keep freed memory for what it allocates next; whether the C library can be told so.

    glibc gives large blocks back to the system, which clears their pages before each use: a training step on a CPU
    frees and asks for the same gigabytes as the step before, and takes 1.11 times as long (MambaLoc). A ``MALLOC_``
    variable of the user's is left in charge.
    """
    if sys.platform != "linux" or any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in os.environ):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    return mallopt is not None and all(mallopt(of, _KEPT_BYTES) for of in (_TRIM_THRESHOLD, _MMAP_THRESHOLD))

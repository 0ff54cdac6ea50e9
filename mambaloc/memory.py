"""Memory that a process keeps: what the C library does with what is freed, and pages of mapped files."""

from __future__ import annotations

import ctypes
import mmap
import os
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h
_KEPT_BYTES = 2**30


def keep_freed_memory() -> bool:
    """Let this process keep freed memory for what it allocates next; returns whether the C library allows it.

    glibc gives large blocks back to the system, which clears their pages before each use: a training step on a CPU
    frees and asks for the same gigabytes as the step before, and takes 1.11 times as long (MambaLoc). A ``MALLOC_``
    variable of the user's is left in charge.
    """
    if sys.platform != "linux" or any(name.startswith(("MALLOC_", "GLIBC_TUNABLES")) for name in os.environ):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
    return mallopt is not None and all(mallopt(of, _KEPT_BYTES) for of in (_TRIM_THRESHOLD, _MMAP_THRESHOLD))


def release_pages(mapped: NDArray[Any]) -> None:
    """Release the pages of an array that is mapped from a file, so that they do not add up in this process.

    Each page that a process has touched counts as its memory, up to the whole file. The system keeps the pages as long
    as it has room, and touching them again takes microseconds. Nothing that was written is lost.

    Args:
        mapped: an ``np.memmap`` of a mode other than ``c``, whose changes are in no file, or a slice of one. Any other
            array is left alone.
    """
    mapping = getattr(mapped, "_mmap", None)
    if isinstance(mapped, np.memmap) and mapping is not None and hasattr(mmap, "MADV_DONTNEED"):
        mapping.madvise(mmap.MADV_DONTNEED)

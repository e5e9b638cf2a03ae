"""How the C library handles memory that a training frees."""

import ctypes
import os
import sys

# Of glibc's malloc.h.
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
_KEPT_BYTES = 2**30
_VARIABLES = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")


def keep_freed_memory() -> None:
    """Have glibc keep freed blocks of up to 1 GiB for the next step, in place of giving them back to the system.

    A training step on a CPU allocates and frees the same activations each time. Returned to the system, every page
    of them is fetched and zeroed anew in the next step. Does nothing with other C libraries, nor where the user has
    set one of glibc's own variables.
    """
    if not sys.platform.startswith("linux") or any(name in os.environ for name in _VARIABLES):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # musl has none
        mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)

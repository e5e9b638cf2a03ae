"""How the C library handles memory that a training frees."""

import ctypes
import os
import sys

# Of glibc's malloc.h.
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
_KEPT_BYTES = 2**30
_LARGEST_BEFORE_2_35 = 2**25  # glibc before 2.35 refuses a higher threshold of blocks of their own
_VARIABLES = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")


def keep_freed_memory() -> None:
    """Have glibc keep freed blocks for the next step, in place of giving them back to the system.

    A training step on a CPU allocates and frees the same activations each time. Returned to the system, every page
    of them is fetched and zeroed anew in the next step. Blocks of up to 1 GiB are kept, before glibc 2.35 of up to
    32 MiB. Does nothing with other C libraries, nor where the user has set one of glibc's own variables.
    """
    if not sys.platform.startswith("linux") or any(name in os.environ for name in _VARIABLES):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl has none
        return
    # The second setting alone would fix the first at 128 KiB, and cost more than both together save.
    if any(mallopt(_MMAP_THRESHOLD, size) for size in (_KEPT_BYTES, _LARGEST_BEFORE_2_35)):
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)

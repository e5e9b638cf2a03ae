"""How many CPU cores there are to use."""

import os


def usable_cores() -> int:
    """Cores this process may run on: fewer than the machine has under `taskset`, in a container or in a batch job."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

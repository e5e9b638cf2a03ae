"""The CPU: how many cores there are to use, and of what kind."""

import os
import platform
from pathlib import Path

_BFLOAT16_FLAGS = ("amx_bf16", "avx512_bf16", "bf16")  # of /proc/cpuinfo; the last one is Arm's


def usable_cores() -> int:
    """Cores this process may run on: fewer than the machine has under `taskset`, in a container or in a batch job."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cpu_kind() -> str:
    """The processor's name and what multiplies bfloat16 in it, on which speeds and the usual precision depend."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    facts = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    flags = f"{facts.get('flags', '')} {facts.get('Features', '')}".split()
    bfloat16 = next((flag for flag in _BFLOAT16_FLAGS if flag in flags), "no")
    name = facts.get("model name") or platform.processor() or platform.machine()
    return f"{name}, native bfloat16: {bfloat16}"

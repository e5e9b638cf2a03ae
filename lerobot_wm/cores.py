"""The CPU: how many cores there are to use, and of what kind."""

import math
import os
import platform
from pathlib import Path

_BFLOAT16_FLAGS = ("amx_bf16", "avx512_bf16", "bf16")  # of /proc/cpuinfo; the last one is Arm's


_CGROUPS, _OWN_CGROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def usable_cores() -> int:
    """Cores this process may run on: fewer than the machine has under `taskset`, in a container or in a batch job."""
    pinned = hasattr(os, "sched_getaffinity")  # not on macOS and Windows
    cores = len(os.sched_getaffinity(0)) if pinned else os.cpu_count() or 1
    return max(1, math.ceil(min(cores, _cores_worth_of_time())))


def _cores_worth_of_time() -> float:
    """How many cores' time a container or batch job may use at once (cgroup v2); infinite without a limit."""
    if not _OWN_CGROUP.exists():  # not Linux
        return math.inf
    own = [line[3:] for line in _OWN_CGROUP.read_text().splitlines() if line.startswith("0::")]
    limits = [math.inf]
    for folder in (_CGROUPS / path.lstrip("/") for path in own):
        for limited in (folder, *folder.parents):  # a container sees its own group as the topmost one
            file = limited / "cpu.max"
            quota, period = file.read_text().split() if file.is_file() else ("max", "100000")
            if quota != "max":
                limits.append(int(quota) / int(period))
    return min(limits)


def cpu_kind() -> str:
    """The processor's name and what multiplies bfloat16 in it, on which speeds and the usual precision depend."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    facts = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    flags = f"{facts.get('flags', '')} {facts.get('Features', '')}".split()
    bfloat16 = next((flag for flag in _BFLOAT16_FLAGS if flag in flags), "no")
    name = facts.get("model name") or platform.processor() or platform.machine()
    return f"{name}, native bfloat16: {bfloat16}"

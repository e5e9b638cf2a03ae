"""The CPU: how many cores there are to use, and of what kind."""

import ctypes
import json
import math
import os
import platform
import re
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


@contextmanager
def held_back(*numbers: signal.Signals) -> Iterator[None]:
    """Have signals wait: a process that is being started is known, and can be ended, only afterwards.

    Blocking them would not do: a signal that reaches another thread is handled in the main one all the same.

    Args:
        *numbers: Whose handlers wait; the first that arrived is raised afterwards.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread only
        return
    arrived: list[int] = []
    before = {
        number: signal.signal(number, lambda number, frame: arrived.append(number)) for number in numbers
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if arrived:
            signal.raise_signal(arrived[0])


@dataclass(frozen=True)
class Share:
    """The index-th of `count` shares; counted from 1."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Share":
        """Read i/n.

        Raises:
            ValueError: it is not of this form, or i is not one of 1 to n.
        """
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        if match is None:
            raise ValueError(f"shard is {text!r}; expected i/n, such as 1/4 for the first of four jobs.")
        index, count = int(match[1]), int(match[2])
        if not 1 <= index <= count:
            raise ValueError(
                f"shard is {text}; expected i from 1 to n, such as 1/4 for the first of four jobs."
            )
        return cls(index, count)

    def of[T](self, parts: Sequence[T]) -> list[T]:
        """This job's parts, as many of each stretch as the other jobs have.

        Raises:
            ValueError: there are fewer parts than jobs.
        """
        if len(parts) < self.count:
            raise ValueError(
                f"shard is {self.index}/{self.count}, but this work has only {len(parts)} parts: "
                f"start at most {len(parts)} jobs."
            )
        return list(parts[self.index - 1 :: self.count])


def shards_folder(root: Path) -> Path:
    """Where the shards of the collection of the dataset `root` lie until they are merged."""
    return root.with_name(f"{root.name}.shards")


def parts_folder(root: Path) -> Path:
    """Where the latents of the dataset `root` lie until all are encoded."""
    return root.with_name(f"{root.name}.parts")


def refuse_difference(found: Mapping[str, Any], expected: Mapping[str, Any], what: str, mend: str) -> None:
    """Refuse work that was done with other settings.

    Args:
        found: its settings, read from JSON.
        expected: those of this run.
        what: what was found, such as "x.shards/reach-v3-00000 is a shard".
        mend: what to do about it.

    Raises:
        FileExistsError: naming each setting that differs.
    """
    # Through JSON, so that both sides have its types.
    expected = json.loads(json.dumps(expected))
    different = [
        f"{name} {found.get(name)} there, {value} here"
        for name, value in expected.items()
        if found.get(name) != value
    ]
    if different:
        raise FileExistsError(f"{what} made with other settings ({'; '.join(different)}); {mend}.")

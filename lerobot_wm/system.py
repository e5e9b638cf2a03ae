"""The machine: usable cores, the kind of CPU, memory, and the log messages of other libraries."""

import ctypes
import getpass
import logging
import math
import os
import platform
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# CPU flags of /proc/cpuinfo; the last one is Arm's.
_BFLOAT16_FLAGS = ("amx_bf16", "avx512_bf16", "bf16")
_CGROUPS, _OWN_CGROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
# From glibc's malloc.h.
_TRIM_THRESHOLD = -1
_MMAP_THRESHOLD = -3
_KEPT_BYTES = 2**30
# glibc before 2.35 refuses a higher mmap threshold.
_LARGEST_BEFORE_2_35 = 2**25
_VARIABLES = ("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_")


def usable_cores() -> int:
    """Cores that this process may use; fewer than the machine has under `taskset`, in a container or in a batch job."""
    # Not on macOS and Windows.
    pinned = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if pinned else os.cpu_count() or 1
    return max(1, math.ceil(min(cores, _cgroup_cores())))


def _cgroup_cores() -> float:
    """Cores' worth of time that a container or batch job may use (cgroup v2); infinite without a limit."""
    if not _OWN_CGROUP.exists():  # not Linux
        return math.inf
    own = [line[3:] for line in _OWN_CGROUP.read_text().splitlines() if line.startswith("0::")]
    limits = [math.inf]
    for folder in (_CGROUPS / path.lstrip("/") for path in own):
        # A container sees its own group as the topmost one.
        for limited in (folder, *folder.parents):
            file = limited / "cpu.max"
            quota, period = file.read_text().split() if file.is_file() else ("max", "100000")
            if quota != "max":
                limits.append(int(quota) / int(period))
    return min(limits)


def cpu_kind() -> str:
    """The processor's name and its bfloat16 instructions, on which speed and the default precision depend."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    facts = {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    flags = f"{facts.get('flags', '')} {facts.get('Features', '')}".split()
    bfloat16 = next((flag for flag in _BFLOAT16_FLAGS if flag in flags), "no")
    name = facts.get("model name") or platform.processor() or platform.machine()
    return f"{name}, native bfloat16: {bfloat16}"


def keep_freed_memory() -> None:
    """Let glibc keep freed memory for the next training step instead of returning it to the system.

    A training step on a CPU allocates and frees the same activations each time; memory that was returned must be
    fetched and zeroed again, page by page. Blocks of up to 1 GiB are kept (32 MiB before glibc 2.35). Does nothing
    with other C libraries, or where the user has set one of glibc's own variables.
    """
    if not sys.platform.startswith("linux") or any(name in os.environ for name in _VARIABLES):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl has none
        return
    # The second setting alone would fix the first at 128 KiB, and cost more than both together save.
    if any(mallopt(_MMAP_THRESHOLD, size) for size in (_KEPT_BYTES, _LARGEST_BEFORE_2_35)):
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)


def name_user() -> None:
    """Give a user id without a name, as in `docker run --user`, a name for this process; PyTorch's import needs one."""
    try:
        getpass.getuser()
    except (KeyError, OSError):  # OSError from Python 3.13 on
        os.environ["USER"] = f"user{os.getuid()}"


# What a message about OpenGL says -> how to fix it.
_OPENGL_FIXES = {
    "MUJOCO_EGL_DEVICE_ID": "unset MUJOCO_EGL_DEVICE_ID, or set it to the number of a GPU that is there",
    "invalid literal for int": "unset MUJOCO_EGL_DEVICE_ID, or set it to the number of a GPU that is there",
    "MUJOCO_GL": "unset MUJOCO_GL, or set it to egl or osmesa",
}
_OPENGL_PACKAGES = (
    "on Debian or Ubuntu run apt-get install -y --no-install-recommends libegl1 libgl1 libopengl0 libgl1-mesa-dri and "
    "use MUJOCO_GL=egl (the default)"
)


def opengl_fix(reason: str) -> str:
    """How to fix OpenGL that does not start.

    Args:
        reason: The message of MuJoCo or PyOpenGL. They name a variable with a wrong value; without a library or a
            driver they say all kinds of things.
    """
    return next((fix for text, fix in _OPENGL_FIXES.items() if text in reason), _OPENGL_PACKAGES)


@contextmanager
def quiet() -> Iterator[None]:
    """Hide what LeRobot, `datasets` and the video codec print per episode; errors are shown.

    The codec stays quiet afterwards: its previous level cannot be read.
    """
    import datasets

    logger = logging.getLogger("lerobot")
    level = logger.level
    bars = datasets.utils.logging.is_progress_bar_enabled()
    try:
        with warnings.catch_warnings():
            silence()
            yield
    finally:
        logger.setLevel(level)
        if bars:
            datasets.enable_progress_bars()


def silence() -> None:
    """Do what `quiet` does, for the rest of this process."""
    import av.logging
    import datasets

    logging.getLogger("lerobot").setLevel(logging.ERROR)
    av.logging.set_libav_level(av.logging.ERROR)
    datasets.disable_progress_bars()
    # Scripted experts command more than +-1 by design; actions are clipped before they are recorded.
    warnings.filterwarnings("ignore", message="Constant.s. may be too high")


def hide_harmless_messages() -> None:
    """Hide messages of LeRobot and PyOpenGL that are not about a problem, for the rest of this process."""
    # LeRobot warns once per video that torchcodec is missing; PyAV decodes videos as well.
    logging.getLogger("lerobot.utils.import_utils").addFilter(
        lambda record: "'torchcodec' is not available" not in record.getMessage()
    )
    # A name that LeRobot chose for the job.
    logging.getLogger("lerobot.configs.eval").setLevel(logging.ERROR)
    # The accelerator module of PyOpenGL is not installed.
    logging.getLogger("OpenGL.acceleratesupport").setLevel(logging.WARNING)

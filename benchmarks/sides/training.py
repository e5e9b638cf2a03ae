"""`lerobot-wm train` and `lerobot-train` with the same flags, timed by their log lines."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.data import dataset_flags, demonstrations, latents
from benchmarks.timing import Prepared

OURS = "lerobot_wm.cli", "train"
LEROBOT = ("lerobot.scripts.lerobot_train",)
LOG_LINE = re.compile(r"\bstep:\d")  # LeRobot logs one such line every `log_freq` steps
PREFETCH_FACTOR = 4  # LeRobot's default: batches that each worker has ready when training starts


def wm_rssm(folder: Path, **size: Any) -> Prepared:
    """Time our command training the world model."""
    return _prepared(OURS, folder, "wm_rssm", log_freq=1, **size)


def lerobot_wm_rssm(folder: Path, **size: Any) -> Prepared:
    """Time LeRobot's command training the world model."""
    return _prepared(LEROBOT, folder, "wm_rssm", log_freq=1, **size)


def wm_iql(folder: Path, **size: Any) -> Prepared:
    """Time our command training IQL on latents."""
    return _prepared(OURS, folder, "wm_iql", log_freq=50, **size)


def lerobot_wm_iql(folder: Path, **size: Any) -> Prepared:
    """Time LeRobot's command training IQL on latents."""
    return _prepared(LEROBOT, folder, "wm_iql", log_freq=2, **size)


def wm_bc(folder: Path, **size: Any) -> Prepared:
    """Time our command training BC on latents."""
    return _prepared(OURS, folder, "wm_bc", log_freq=50, **size)


def lerobot_wm_bc(folder: Path, **size: Any) -> Prepared:
    """Time LeRobot's command training BC on latents."""
    return _prepared(LEROBOT, folder, "wm_bc", log_freq=2, **size)


def _prepared(
    module: tuple[str, ...],
    folder: Path,
    policy: str,
    *,
    log_freq: int,
    batch: int,
    episodes_per_task: int,
    workers: int,
    seconds: float,
) -> Prepared:
    if policy == "wm_rssm":
        dataset, of_policy = demonstrations(folder, episodes_per_task), []
    else:
        dataset, checkpoint = latents(folder, episodes_per_task)
        of_policy = [f"--policy.world_model_path={checkpoint}"]
    command = [
        *(sys.executable, "-m", *module),
        f"--policy.type={policy}",
        *of_policy,
        *("--policy.push_to_hub=false", "--policy.device=cpu"),
        *dataset_flags(dataset),
        f"--batch_size={batch}",
        f"--num_workers={workers}",
        f"--log_freq={log_freq}",
        *("--steps=1000000", "--save_checkpoint=false", "--seed=0"),
    ]
    warm_up = workers * PREFETCH_FACTOR  # these steps use batches that were ready before
    return Prepared(lambda: _steps_per_second(command, folder, log_freq, warm_up, seconds))


def _steps_per_second(command: list[str], folder: Path, log_freq: int, warm_up: int, seconds: float) -> float:
    """Measure steps per second between two log lines of a command, then end it.

    Args:
        command: The command without its output folder.
        folder: Parent of the output folder.
        log_freq: Steps between log lines.
        warm_up: Steps to skip before the first line counts.
        seconds: Minimum time between the two lines.

    Raises:
        RuntimeError: The command ended early.
    """
    output = Path(tempfile.mkdtemp(dir=folder)) / "run"
    process = subprocess.Popen(
        [*command, f"--output_dir={output}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # so that the loader's workers can be ended with it
    )
    assert process.stdout is not None
    lines: list[str] = []
    step = 0
    times: list[float] = []
    try:
        for line in process.stdout:
            lines.append(line)
            if LOG_LINE.search(line):
                step += log_freq
                if step < warm_up:
                    continue
                times.append(time.perf_counter())
                if len(times) > 1 and times[-1] - times[0] >= seconds:
                    return (len(times) - 1) * log_freq / (times[-1] - times[0])
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            process.wait()
    raise RuntimeError(f"{' '.join(command)} ended early:\n{''.join(lines[-20:])}")

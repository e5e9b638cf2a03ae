"""`lerobot-wm train` and `lerobot-train` with the same flags, timed by their own log lines."""

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.data import dataset_flags, demonstrations, latents
from benchmarks.timing import Prepared

OURS = "lerobot_wm.cli", "train"
LEROBOT = ("lerobot.scripts.lerobot_train",)
LOG_LINE = re.compile(r"\bstep:\d")  # LeRobot's metrics, one line every `log_freq` steps
PREFETCH_FACTOR = 4  # LeRobot's default: batches each worker has ready when training starts


def wm_rssm(folder: Path, **size: Any) -> Prepared:
    """Our command, the world model."""
    return _prepared(OURS, folder, "wm_rssm", log_freq=1, **size)


def lerobot_wm_rssm(folder: Path, **size: Any) -> Prepared:
    """LeRobot's command, the world model."""
    return _prepared(LEROBOT, folder, "wm_rssm", log_freq=1, **size)


def wm_iql(folder: Path, **size: Any) -> Prepared:
    """Our command, IQL on latents."""
    return _prepared(OURS, folder, "wm_iql", log_freq=50, **size)


def lerobot_wm_iql(folder: Path, **size: Any) -> Prepared:
    """LeRobot's command, IQL on latents."""
    return _prepared(LEROBOT, folder, "wm_iql", log_freq=2, **size)


def in_one_step(folder: Path, policy: str, updates: int, batch: int, width: int, seconds: float) -> Prepared:
    """Our command, a policy with networks of one width, several updates on `batch` samples each in a step."""
    flags = (f"--policy.updates_per_step={updates}", f"--policy.hidden_dims=[{width},{width}]")
    size = {"batch": updates * batch, "episodes_per_task": 16, "workers": 0, "seconds": seconds}
    return _prepared(OURS, folder, policy, log_freq=max(1, 50 // updates), flags=flags, **size)


def wm_bc(folder: Path, **size: Any) -> Prepared:
    """Our command, BC on latents."""
    return _prepared(OURS, folder, "wm_bc", log_freq=50, **size)


def lerobot_wm_bc(folder: Path, **size: Any) -> Prepared:
    """LeRobot's command, BC on latents."""
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
    flags: Sequence[str] = (),
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
        *flags,
    ]
    warm_up = workers * PREFETCH_FACTOR  # these steps are fed with what was ready before
    return Prepared(lambda: _steps_per_second(command, folder, log_freq, warm_up, seconds))


def _steps_per_second(command: list[str], folder: Path, log_freq: int, warm_up: int, seconds: float) -> float:
    """Between two log lines of a command, which is then ended.

    Args:
        command: The command without its output folder.
        folder: Where that is made.
        log_freq: Steps from line to line.
        warm_up: Steps that are over at the first of the two lines.
        seconds: Time after which the second one is the next line.

    Raises:
        RuntimeError: The command ended before.
    """
    output = Path(tempfile.mkdtemp(dir=folder)) / "run"
    process = subprocess.Popen(
        [*command, f"--output_dir={output}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # so that its loader's workers end with it
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

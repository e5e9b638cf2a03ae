"""Whole commands, start-up included: collection, and evaluation beside LeRobot's own."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from lerobot.policies import make_pre_post_processors

from benchmarks.data import REPO_ID, TASKS, wm_bc
from benchmarks.timing import Prepared
from lerobot_wm.constants import IMAGE_SIZE, MT6

LEROBOT_VIDEOS = 10  # per task; lerobot-eval has no flag to change it
LEROBOT_IMAGE_SIZE = 480  # the only size of its metaworld environment; the policy scales images down


def collect(folder: Path, episodes_per_task: int, workers: int) -> Prepared:
    """Measure episodes per minute of `lerobot-wm collect` on the six tasks."""
    command = [
        *("lerobot_wm.cli", "collect", "--tasks=mt6", f"--repo_id={REPO_ID}"),
        *(f"--episodes_per_task={episodes_per_task}", f"--num_workers={workers}"),
    ]
    return _per_minute(command, "--root", folder, episodes_per_task * len(MT6))


def evaluate(folder: Path, rollouts_per_task: int, workers: int) -> Prepared:
    """Measure rollouts per minute of `lerobot-wm eval` on metaworld_mt."""
    command = [
        *("lerobot_wm.cli", "eval", "--env.type=metaworld_mt"),
        *(f"--num_workers={workers}", f"--videos_per_task={min(LEROBOT_VIDEOS, rollouts_per_task)}"),
    ]
    return _evaluation(command, IMAGE_SIZE, folder, rollouts_per_task)


def lerobot_evaluate(folder: Path, rollouts_per_task: int, workers: int) -> Prepared:
    """Measure rollouts per minute of `lerobot-eval` on metaworld; it has no flag for workers."""
    command = ["lerobot.scripts.lerobot_eval", "--env.type=metaworld"]
    return _evaluation(command, LEROBOT_IMAGE_SIZE, folder, rollouts_per_task)


def _evaluation(command: list[str], image_size: int, folder: Path, rollouts_per_task: int) -> Prepared:
    checkpoint = folder / f"wm_bc-{image_size}"
    if not checkpoint.is_dir():
        # The untrained policy never succeeds, so every rollout takes 500 steps on both sides.
        policy = wm_bc(image_size)
        policy.save_pretrained(checkpoint)
        for processor in make_pre_post_processors(policy.config):
            processor.save_pretrained(checkpoint)
    flags = [
        *(f"--policy.path={checkpoint}", "--policy.device=cpu", f"--env.task={TASKS}", "--seed=0"),
        *(f"--eval.n_episodes={rollouts_per_task}", f"--eval.batch_size={rollouts_per_task}"),
    ]
    return _per_minute([*command, *flags], "--output_dir", folder, rollouts_per_task * len(TASKS.split(",")))


def _per_minute(command: list[str], output_flag: str, folder: Path, units: int) -> Prepared:
    """Measure units of work per minute of a `python -m` command.

    Args:
        command: The module and its flags.
        output_flag: The flag for the output folder, which is new each time.
        folder: Parent of the output folders.
        units: Units of work that the command does.
    """

    def measure() -> float:
        output = Path(tempfile.mkdtemp(dir=folder)) / "output"
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", *command, f"{output_flag}={output}"], check=True)
        return units * 60 / (time.perf_counter() - start)

    return Prepared(measure)

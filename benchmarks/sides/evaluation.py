"""Rollouts of one policy with `lerobot-wm eval`, and with LeRobot's own environment and command."""

from pathlib import Path

from lerobot.policies import make_pre_post_processors

from benchmarks.data import TASKS
from benchmarks.policies import wm_bc
from benchmarks.sides.command import per_minute
from benchmarks.timing import Prepared
from lerobot_wm.constants import IMAGE_SIZE

LEROBOT_VIDEOS = 10  # per task; lerobot-eval has no flag to change it
LEROBOT_IMAGE_SIZE = 480  # the only size of its metaworld environment; the policy scales images down


def ours(folder: Path, rollouts_per_task: int, workers: int) -> Prepared:
    """Measure rollouts per minute of `lerobot-wm eval` on metaworld_mt."""
    command = [
        *("lerobot_wm.cli", "eval", "--env.type=metaworld_mt"),
        *(f"--num_workers={workers}", f"--videos_per_task={min(LEROBOT_VIDEOS, rollouts_per_task)}"),
    ]
    return _prepared(command, IMAGE_SIZE, folder, rollouts_per_task)


def lerobot(folder: Path, rollouts_per_task: int, workers: int) -> Prepared:
    """Measure rollouts per minute of `lerobot-eval` on metaworld; it has no flag for workers."""
    command = ["lerobot.scripts.lerobot_eval", "--env.type=metaworld"]
    return _prepared(command, LEROBOT_IMAGE_SIZE, folder, rollouts_per_task)


def _prepared(command: list[str], image_size: int, folder: Path, rollouts_per_task: int) -> Prepared:
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
    return per_minute([*command, *flags], "--output_dir", folder, rollouts_per_task * len(TASKS.split(",")))

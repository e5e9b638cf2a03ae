"""Collection of demonstrations."""

from pathlib import Path

from benchmarks.data import REPO_ID
from benchmarks.sides.command import per_minute
from benchmarks.timing import Prepared
from lerobot_wm.constants import MT6


def ours(folder: Path, episodes_per_task: int, workers: int) -> Prepared:
    """Measure episodes per minute of `lerobot-wm collect` on the six tasks."""
    command = [
        *("lerobot_wm.cli", "collect", "--tasks=mt6", f"--repo_id={REPO_ID}"),
        *(f"--episodes_per_task={episodes_per_task}", f"--num_workers={workers}"),
    ]
    return per_minute(command, "--root", folder, episodes_per_task * len(MT6))

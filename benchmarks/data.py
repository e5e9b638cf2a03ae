"""Datasets and checkpoints that the rows need, made on first use with the project's own commands."""

import subprocess
import sys
from pathlib import Path

TASKS = "reach-v3,window-close-v3"
REPO_ID = "benchmark/data"


def lerobot_wm(command: str, *flags: str) -> None:
    """Run `lerobot-wm COMMAND FLAGS`."""
    subprocess.run([sys.executable, "-m", "lerobot_wm.cli", command, *flags], check=True)


def demonstrations(folder: Path, episodes_per_task: int) -> Path:
    """Return the root of a dataset of scripted demonstrations of two tasks with 64x64 images."""
    root = folder / f"demonstrations-{episodes_per_task}"
    if not root.is_dir():
        lerobot_wm(
            "collect",
            f"--tasks={TASKS}",
            f"--episodes_per_task={episodes_per_task}",
            f"--repo_id={REPO_ID}",
            f"--root={root}",
        )
    return root


def world_model(folder: Path, dataset: Path) -> Path:
    """Return the checkpoint of an untrained world model."""
    output = folder / f"world_model-{dataset.name}"
    if not output.is_dir():
        lerobot_wm("init", "--policy.type=wm_rssm", *dataset_flags(dataset), f"--output_dir={output}")
    return output / "pretrained_model"


def latents(folder: Path, episodes_per_task: int) -> tuple[Path, Path]:
    """Return the root of the demonstrations' latents, and the checkpoint of their world model."""
    dataset = demonstrations(folder, episodes_per_task)
    checkpoint = world_model(folder, dataset)
    root = folder / f"latents-{episodes_per_task}"
    if not root.is_dir():
        lerobot_wm(
            "encode",
            f"--world_model_path={checkpoint}",
            *dataset_flags(dataset),
            f"--output_repo_id={REPO_ID}",
            f"--output_root={root}",
            "--device=cpu",
        )
    return root, checkpoint


def dataset_flags(root: Path) -> list[str]:
    """Return the flags that name a dataset of this module."""
    return [f"--dataset.repo_id={REPO_ID}", f"--dataset.root={root}"]

"""Datasets, checkpoints and untrained policies that the rows need; speed does not depend on the weights."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature

from lerobot_wm.constants import ACTION, ACTION_DIM, MT6, OBS_IMAGE, OBS_STATE, STATE_DIM
from lerobot_wm.envs.tasks import task_description
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.world_model.config import RSSMConfig

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


def input_features(image_size: int) -> dict[str, PolicyFeature]:
    """Return the features of one camera and proprioception."""
    return {
        OBS_IMAGE: PolicyFeature(type=FeatureType.VISUAL, shape=(3, image_size, image_size)),
        OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,)),
    }


def output_features() -> dict[str, PolicyFeature]:
    """Return the feature of Meta-World's action."""
    return {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,))}


def wm_bc(image_size: int) -> WMBCPolicy:
    """Make a wm_bc with its world model for the six tasks; it scales images of other sizes to 64x64."""
    common: dict[str, Any] = {
        "device": "cpu",
        "push_to_hub": False,
        "input_features": input_features(image_size),
        "output_features": output_features(),
        "image_key": OBS_IMAGE,
    }
    world_model = WMRSSMConfig(rssm=RSSMConfig(image_channels=3, action_dim=ACTION_DIM), **common)
    config = WMBCConfig(world_model=world_model, tasks=[task_description(task) for task in MT6], **common)
    return WMBCPolicy(config).eval()

"""`lerobot-wm init`: the checkpoint of an untrained policy.

Two controls need one: an RSSM that was never trained, and a frozen image backbone in place of the world model.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.random_utils import set_seed

from lerobot_wm.data.options import SourceConfig
from lerobot_wm.files import sole_writer


@dataclass
class InitConfig:
    """Flags of `lerobot-wm init`.

    Args:
        policy: `--policy.type=...` and its flags, as in `lerobot-train`.
        dataset: Gives the sizes and the statistics that scale actions and proprioception.
        output_dir: The checkpoint is written to its folder `pretrained_model`.
        seed: Seed of the random weights.
    """

    policy: PreTrainedConfig
    dataset: SourceConfig
    output_dir: Path
    seed: int = 0


def initialise(cfg: InitConfig) -> Path:
    """Write the checkpoint; it appears when it is whole.

    Returns:
        Its folder, for `--world_model_path` and `--policy.world_model_path`.

    Raises:
        FileExistsError: It is there already.
        BlockingIOError: Another process writes it.
        ValueError: The policy does not fit the dataset.
    """
    folder = cfg.output_dir / PRETRAINED_MODEL_DIR
    with sole_writer(folder):
        if folder.exists():
            raise FileExistsError(f"{folder} is there already: choose another --output_dir, or remove it.")
        _write(cfg, folder)
    return folder


def _write(cfg: InitConfig, folder: Path) -> None:
    meta = LeRobotDatasetMetadata(cfg.dataset.repo_id, root=cfg.dataset.root, revision=cfg.dataset.revision)
    set_seed(cfg.seed)
    policy = make_policy(cfg.policy, ds_meta=meta)
    partial = folder.with_name(f"{PRETRAINED_MODEL_DIR}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    policy.save_pretrained(partial)
    for processor in make_pre_post_processors(cfg.policy, dataset_stats=meta.stats):
        processor.save_pretrained(partial)
    partial.rename(folder)


def main() -> None:
    """Entry point of `lerobot-wm init`."""
    print(f"Untrained checkpoint: {initialise(draccus.parse(InitConfig))}")

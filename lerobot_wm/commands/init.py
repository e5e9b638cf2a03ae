"""`lerobot-wm init`: write the checkpoint of an untrained policy.

Two baselines need one: an RSSM that was never trained, and a frozen image backbone in place of the world model.
"""

from dataclasses import dataclass
from pathlib import Path

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.constants import PRETRAINED_MODEL_DIR
from lerobot.utils.random_utils import set_seed

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.files import new_folder


@dataclass
class InitConfig:
    """Flags of `lerobot-wm init`.

    Args:
        policy: `--policy.type=...` and its flags, as in `lerobot-train`.
        dataset: The dataset that gives sizes, and the statistics that scale actions and proprioception.
        output_dir: The checkpoint is written to `pretrained_model` in this folder.
        seed: Seed of the random weights.
    """

    policy: PreTrainedConfig
    dataset: SourceConfig
    output_dir: Path
    seed: int = 0


def initialise(cfg: InitConfig) -> Path:
    """Write the checkpoint.

    Returns:
        Its folder, for `--world_model_path` and `--policy.world_model_path`.

    Raises:
        FileExistsError: The checkpoint exists already.
        BlockingIOError: Another process is writing it.
        ValueError: The policy does not fit the dataset.
    """
    folder = cfg.output_dir / PRETRAINED_MODEL_DIR
    with new_folder(folder) as temporary:
        meta = cfg.dataset.metadata()
        set_seed(cfg.seed)
        make_policy(cfg.policy, ds_meta=meta).save_pretrained(temporary)
        for processor in make_pre_post_processors(cfg.policy, dataset_stats=meta.stats):
            processor.save_pretrained(temporary)
    return folder


def main() -> None:
    """Entry point of `lerobot-wm init`."""
    print(f"Untrained checkpoint: {initialise(draccus.parse(InitConfig))}")

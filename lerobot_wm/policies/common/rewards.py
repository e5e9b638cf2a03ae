"""Which column of the dataset is the reward, and reading it where LeRobot's batches leave it out."""

from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import DONE, REWARD
from lerobot_wm.data.tables import frame_numbers

IN_BATCHES = (REWARD, DONE)  # of the columns next.*, those that LeRobot's processors let through


@dataclass
class RewardConfig(PreTrainedConfig):
    """A policy that learns from a reward.

    Args:
        reward_key: The dataset's column that is the reward: next.success, for a sparse reward of 1 at success where
            next.reward is a dense one.
    """

    reward_key: str = REWARD


def reward_columns(dataset_meta: LeRobotDatasetMetadata) -> list[str]:
    """The columns next.* of one number per frame, each of which can be a reward."""
    return [
        name
        for name, feature in dataset_meta.features.items()
        if name.startswith("next.") and name != DONE and tuple(feature["shape"]) == (1,)
    ]


class FrameLabel(nn.Module):
    """A column of one number per frame, as batches of training data know it.

    Args:
        key: The column.
        dataset_meta: The dataset to train on; None when a checkpoint is loaded to act.
    """

    values: Tensor

    def __init__(self, key: str, dataset_meta: LeRobotDatasetMetadata | None) -> None:
        super().__init__()
        self.key = key
        if dataset_meta is not None and key not in IN_BATCHES:
            # (N,) by absolute frame index; the dataset's, no part of a checkpoint.
            self.register_buffer("values", frame_numbers(dataset_meta, key), persistent=False)

    def forward(self, batch: dict[str, Any], n_steps: int = 1) -> Tensor:
        """The column at each of the batch's frames and the `n_steps` - 1 after it: (B, n_steps).

        Beyond the end of an episode it is of the next one; what is read there does not count.
        """
        if self.key in IN_BATCHES:
            return batch[self.key]
        steps = torch.arange(n_steps, device=self.values.device)
        index = batch["index"].reshape(-1, 1) + steps  # (B, n_steps)
        return self.values[index.clamp(max=len(self.values) - 1)]

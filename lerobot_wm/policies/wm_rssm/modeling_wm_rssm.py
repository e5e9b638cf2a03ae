"""The world model as a LeRobot policy: `compute_loss` is its training loss on windows."""

from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.io_utils import load_stats
from torch import Tensor

from lerobot_wm.constants import ACTION
from lerobot_wm.nn.images import camera_images
from lerobot_wm.policies.common.config import compiled
from lerobot_wm.policies.common.features import Statistics, join_vectors, joined_statistics, statistics
from lerobot_wm.policies.common.iql import FrameColumn
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.world_model.policy import WorldModelPolicy
from lerobot_wm.world_model.model import WorldModel


class WMRSSMPolicy(WorldModelPolicy):
    """An RSSM pretrained on the images and actions of all tasks."""

    config_class = WMRSSMConfig
    name = "wm_rssm"
    config: WMRSSMConfig
    world_model: WorldModel

    def build(self) -> None:
        """Make the world model."""
        self.world_model = WorldModel(self.config.rssm)
        self.rewards = FrameColumn(self.config.reward_key)
        self._learns_reward = self.config.rssm.predict_reward

    def fit_dataset(self, stats: Statistics, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Set the scalings."""
        model, config = self.world_model, self.config
        model.action_scaling.set_range(*statistics(stats, ACTION, "min", "max"))
        if config.rssm.use_proprio:
            model.proprio_scaling.set_standard(
                *joined_statistics(stats, config.proprio_vectors, "mean", "std")
            )
        if config.rssm.standardize_images:
            # By default LeRobot replaces the cameras' statistics in memory with ImageNet's: read the dataset's own.
            own = load_stats(dataset_meta.root) or {}
            by_camera = [statistics(own, key, "mean", "std") for key in config.cameras]
            model.image_scaling.set_standard(*map(torch.cat, zip(*by_camera, strict=True)))

    def prepare_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Read rewards from the dataset's column where there is one, fit windows to its episodes, and compile."""
        config = self.config
        config.fit_windows(min(dataset_meta.episodes["length"]))
        self._learns_reward = config.rssm.predict_reward and config.has_reward(dataset_meta)
        self.rewards = FrameColumn(config.reward_key, dataset_meta if self._learns_reward else None)
        # Only for training: a filter's episodes have many lengths, and each would be compiled separately.
        if config.compile_model:
            rssm = self.world_model.rssm
            rssm.observe = compiled(rssm.observe)  # type: ignore[method-assign]

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """The world-model loss on a batch of windows.

        Args:
            batch: Each camera (B, T, C, H, W) in [0, 1], `action` (B, T+K-1, A) with an `action_horizon` of K,
                `action_is_pad` (B, T+K-1), and `next.reward` (B, T) or `index` (B,), `observation.state` (B, T, P)
                where the configuration uses them.

        Returns:
            The scalar loss, and its parts by name.
        """
        config = self.config
        return self.world_model.loss(
            images=camera_images(batch, config.cameras, config.image_size),
            actions=batch[ACTION],
            valid=~batch[f"{ACTION}_is_pad"],
            rewards=self.rewards(batch, config.window_length) if self._learns_reward else None,
            proprio=join_vectors(batch, config.proprio_vectors),
        )

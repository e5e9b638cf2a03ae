"""The world model as a LeRobot policy: `forward` is its training loss on windows."""

from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.io_utils import load_stats
from torch import Tensor

from lerobot_wm.constants import ACTION, OBS_STATE, REWARD
from lerobot_wm.policies.common.cameras import camera_images
from lerobot_wm.policies.common.config import compiled
from lerobot_wm.policies.common.features import logged, stat
from lerobot_wm.policies.common.rewards import FrameLabel, reward_columns
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.world_model.policy import WorldModelPolicy
from lerobot_wm.world_model.model import WorldModel


class WMRSSMPolicy(WorldModelPolicy):
    """An RSSM pretrained on the images and actions of all tasks."""

    config_class = WMRSSMConfig
    name = "wm_rssm"
    config: WMRSSMConfig
    world_model: WorldModel

    def __init__(
        self,
        config: WMRSSMConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        if dataset_stats is not None:  # made new: settings of another world model hold its sizes
            config.rssm.action_dim = config.rssm.image_channels = config.rssm.proprio_dim = 0
        made_new = config.rssm.action_dim == 0
        super().__init__(config, dataset_stats, dataset_meta)
        self._learns_reward = config.rssm.predict_reward
        if dataset_meta is not None:  # to be trained
            config.fit_windows(min(dataset_meta.episodes["length"]))
            if not self._has_reward(dataset_meta):
                self._learns_reward = False
                if made_new:
                    config.rssm.predict_reward = False  # without the head; a checkpoint's stays as it was
        self.rewards = FrameLabel(config.reward_key, dataset_meta)
        self.world_model = WorldModel(config.rssm)
        # Only to be trained: a filter's episodes have all kinds of lengths, and each would be compiled anew.
        if config.compile_model and dataset_meta is not None:
            rssm = self.world_model.rssm
            rssm.observe = compiled(rssm.observe)  # type: ignore[method-assign]
        if dataset_stats is not None:  # made new: a checkpoint has its own
            self.world_model.action_scaling.set_range(
                stat(dataset_stats, ACTION, "min"), stat(dataset_stats, ACTION, "max")
            )
            if config.rssm.use_proprio:
                self.world_model.proprio_scaling.set_standard(
                    stat(dataset_stats, OBS_STATE, "mean"), stat(dataset_stats, OBS_STATE, "std")
                )
            if config.rssm.standardize_images:
                # LeRobot lays ImageNet's statistics over the cameras' in memory, by default: read their own.
                own = dataset_stats if dataset_meta is None else load_stats(dataset_meta.root)
                self.world_model.image_scaling.set_standard(
                    *(torch.cat([stat(own, key, name) for key in config.cameras]) for name in ("mean", "std"))
                )

    def _has_reward(self, dataset_meta: LeRobotDatasetMetadata) -> bool:
        """Whether there is a reward to predict; a column that was asked for must be there."""
        key, known = self.config.reward_key, reward_columns(dataset_meta)
        if key not in known and key != REWARD:
            raise ValueError(
                f"--policy.reward_key={key}: {dataset_meta.repo_id} has no such column; of one number per frame it has "
                f"{', '.join(known) or 'none'}. Name one of these, or {REWARD}: where that is missing, none is learned."
            )
        return key in known

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """The world-model loss on a batch of windows.

        Args:
            batch: Each camera (B, T, C, H, W) in [0, 1], `action` (B, T, A), `action_is_pad` (B, T), and
                `next.reward` (B, T) or `index` (B,), `observation.state` (B, T, P) where the configuration uses them.

        Returns:
            The scalar loss and its parts by name.
        """
        rssm = self.config.rssm
        loss, parts = self.world_model.loss(
            images=camera_images(self.config, batch),
            actions=batch[ACTION],
            valid=~batch[f"{ACTION}_is_pad"],
            rewards=self.rewards(batch, batch[ACTION].shape[1]) if self._learns_reward else None,
            proprio=batch[OBS_STATE] if rssm.use_proprio else None,
        )
        return loss, logged(parts)

"""A policy trained from pixels: an image encoder under the heads of the policies on latents."""

from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from lerobot_wm.constants import OBS_STATE
from lerobot_wm.nn.image_encoders import FEATURE_DIM, ImageEncoder
from lerobot_wm.nn.images import random_crop
from lerobot_wm.policies.common.cameras import camera_images, check_observation
from lerobot_wm.policies.common.multi_task_policy import MultiTaskPolicy
from lerobot_wm.policies.e2e.config import E2EConfig


class E2EPolicy(MultiTaskPolicy):
    """Base of `e2e_bc` and `e2e_iql`. Subclasses define `actor_mean` and `forward`."""

    config: E2EConfig

    def __init__(
        self,
        config: E2EConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        if dataset_stats is not None and dataset_meta is not None:
            # Made new: settings of a finished training hold the sizes of that one's cameras.
            found = dataset_to_policy_features(dataset_meta.features)
            config.input_features |= {key: found[key] for key in config.input_features.keys() & found.keys()}
        super().__init__(config, dataset_stats, dataset_meta)
        config.input_features = {key: config.input_features[key] for key in (*config.cameras, OBS_STATE)}
        self.encoder = ImageEncoder(config.encoder, config.image_shape)

    @property
    def observation_dim(self) -> int:
        """Size of the heads' input: image features, one-hot task, proprioception."""
        return FEATURE_DIM + len(self.config.tasks) + self.config.state_dim

    @property
    def task_offset(self) -> int:
        """The one-hot task id follows the image features."""
        return FEATURE_DIM

    def observation(self, images: Tensor, state: Tensor, tasks: Tensor) -> Tensor:
        """Encode the images and join the heads' input.

        Args:
            images: The stacked cameras, (B, C, H, W) in [0, 1]; in training shifted at random where the configuration
                says so, the cameras of a frame alike.
            state: Proprioception in the dataset's units, (B, P).
            tasks: One-hot task ids, (B, N).

        Returns:
            [image features, one-hot task, scaled proprioception], (B, O).
        """
        if self.training and self.config.random_crop_pad:
            images = random_crop(images, self.config.random_crop_pad)
        return torch.cat([self.encoder(images), tasks, self.state_scaling(state)], dim=-1)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Act on the current image: the policy's mean action, clipped, and `action_noise`.

        Args:
            batch: Each camera (B, C, H, W) in [0, 1], `observation.state` (B, P), `task` (B strings).
            **kwargs: Not used; LeRobot passes options of other policies.

        Returns:
            Actions in the dataset's units, (B, A).

        Raises:
            ValueError: A camera is missing or has another size than in training, or the task is unknown.
        """
        if self.training:  # no dropout and no random shifts, as LeRobot's policies act
            self.eval()
        check_observation(self.config, batch)
        images, state = camera_images(self.config, batch), batch[OBS_STATE]
        observation = self.observation(images, state, self.one_hot_tasks(batch, state.shape[0]))
        action = self.action_scaling.inverse(self.actor_mean(observation).clamp(-1, 1))
        return self.with_noise(action, batch)

"""A policy trained from pixels: an image encoder under the heads of the policies on latents."""

from typing import Any

import torch
from torch import Tensor

from lerobot_wm.nn.image_encoders import FEATURE_DIM, ImageEncoder
from lerobot_wm.nn.images import camera_images, random_crop
from lerobot_wm.policies.common.acting_policy import ActingPolicy
from lerobot_wm.policies.e2e.config import E2EConfig


class E2EPolicy(ActingPolicy):
    """Base of `e2e_bc` and `e2e_iql`, which make heads in `build` and define `actor_chunk` and `compute_loss`."""

    config: E2EConfig

    def build(self) -> None:
        """Make the scalings and the image encoder."""
        super().build()
        self.encoder = ImageEncoder(self.config.encoder, self.config.image_shape)

    @property
    def observation_dim(self) -> int:
        """Size of the heads' input: image features, one-hot task, proprioception."""
        return FEATURE_DIM + len(self.config.tasks) + self.config.state_dim

    @property
    def task_start(self) -> int:
        """The one-hot task id follows the image features."""
        return FEATURE_DIM

    def images(self, batch: dict[str, Any]) -> Tensor:
        """The batch's images in [0, 1], resized and stacked: (..., C, H, W)."""
        return camera_images(batch, self.config.cameras, self.config.image_size)

    def observation(self, images: Tensor, state: Tensor, tasks: Tensor) -> Tensor:
        """Encode the images and join the heads' input.

        Args:
            images: The stacked cameras, (B, C, H, W) in [0, 1]; in training with `random_crop_pad` shifted at random,
                all cameras of a frame alike.
            state: Proprioception in the dataset's units, (B, P).
            tasks: One-hot task ids, (B, N).

        Returns:
            [image features, one-hot task, scaled proprioception], (B, O).
        """
        if self.training and self.config.random_crop_pad:
            images = random_crop(images, self.config.random_crop_pad)
        return torch.cat([self.encoder(images), tasks, self.proprioception(state)], dim=-1)

    def observe(self, batch: dict[str, Any], state: Tensor) -> Tensor:
        """Encode the new image; join its features, the one-hot task and proprioception: (B, O)."""
        return self.observation(self.images(batch), state, self.one_hot_tasks(batch, len(state)))

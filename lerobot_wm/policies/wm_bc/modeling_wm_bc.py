"""Multi-task behaviour cloning on world-model latents."""

from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_wm.constants import ACTION, OBS_ENV_STATE, OBS_LATENT, TASK
from lerobot_wm.nn.images import camera_images, random_crop
from lerobot_wm.policies.common.bc import BCPolicy
from lerobot_wm.policies.common.features import join_vectors
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig


class WMBCPolicy(BCPolicy, LatentPolicy):
    """A head on [latent, one-hot task, proprioception], trained on demonstrated actions."""

    config_class = WMBCConfig
    name = "wm_bc"
    config: WMBCConfig  # type: ignore[assignment]

    def prepare_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Give the weights of a world model that is trained a layout whose optimizer state LeRobot can save."""
        super().prepare_training(dataset_meta)
        if self.config.finetune_world_model:
            self.world_model.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]  # its stub lacks it

    def get_optim_params(self) -> dict:
        """The head's parameters, and with `finetune_world_model` also the world model's."""
        trained = [self.actor, self.world_model] if self.config.finetune_world_model else [self.actor]
        return [each for module in trained for each in module.parameters()]  # type: ignore[return-value]  # as LeRobot uses it

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """The head's error on a batch of frames.

        Args:
            batch: `observation.latent` (B, L), `observation.state` (B, P), `action` (B, A) or with chunks (B, K, A) and
                `action_is_pad` (B, K), `task` (B strings), and `observation.environment_state` (B, F) with
                `use_environment_state`. With `finetune_world_model` windows of T frames: cameras (B, T, C, H, W),
                vectors (B, T, ·), and `action` (B, T + K - 1, A).

        Returns:
            The scalar loss, which has no parts.
        """
        if self.config.finetune_world_model:
            batch = self._encode(batch)
        tasks = self.one_hot_tasks(batch, self.batch_size(batch))  # (B, N)
        return self.head_loss(self.observation_at(batch, tasks), batch), {}

    def _encode(self, windows: dict[str, Any]) -> dict[str, Any]:
        """The batch of B·T frames, with their latents, in B windows of T frames."""
        config, length = self.config, self.config.window_length
        images = camera_images(windows, config.cameras, config.image_size)  # (B, T, C, S, S)
        if self.training and config.random_crop_pad:
            together = random_crop(images.flatten(1, 2), config.random_crop_pad)  # one shift for all T frames
            images = together.unflatten(1, images.shape[1:3])
        assert config.world_model is not None  # checked with the features
        embeds = self.world_model.embed(images, join_vectors(windows, config.world_model.proprio_vectors))
        filter_ = self.world_model.filter_embeds if config.use_memory else self.world_model.filter_frames
        states = filter_(embeds, windows[ACTION][:, :length])

        vectors = [*config.state_vectors, *([OBS_ENV_STATE] if config.use_environment_state else [])]
        chunks = windows[ACTION].unfold(1, config.chunk_size, 1).movedim(-1, 2)  # (B, T, K, A)
        is_pad = windows[f"{ACTION}_is_pad"].unfold(1, config.chunk_size, 1)  # (B, T, K)
        frames = {OBS_LATENT: states.latent, ACTION: chunks, f"{ACTION}_is_pad": is_pad}
        frames |= {key: windows[key] for key in vectors}
        tasks = windows.get(TASK)
        return {key: value.flatten(0, 1) for key, value in frames.items()} | {
            TASK: None if tasks is None else [task for task in tasks for _ in range(length)]
        }

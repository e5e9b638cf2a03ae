"""A policy on the latents of a frozen world model: in training it reads them, at test time it filters images."""

import math
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor
from torchvision.utils import make_grid

from lerobot_wm.constants import OBS_ENV_STATE, OBS_LATENT, OBS_STATE
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.policies.common.cameras import camera_images, check_observation, side_by_side
from lerobot_wm.policies.common.features import check_has_stats, logged, stat
from lerobot_wm.policies.common.multi_task_policy import MultiTaskPolicy
from lerobot_wm.policies.latent.config import LatentPolicyConfig
from lerobot_wm.policies.latent.setup import check_latents, deployed_features, take_world_model
from lerobot_wm.world_model.interface import LatentModel, LatentState


class LatentPolicy(MultiTaskPolicy):
    """Base of `wm_bc` and `wm_iql`: holds the frozen world model, or what stands in its place, and the filter's state.

    Subclasses define `actor_mean`, and the training loss by `training_inputs` and `loss`.
    """

    config: LatentPolicyConfig
    world_model: LatentModel  # with `use_latent`

    def __init__(
        self,
        config: LatentPolicyConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        check_has_stats(dataset_meta)
        anew = dataset_stats is not None
        world_model = take_world_model(config, anew=anew) if config.use_latent else None
        config.input_features = deployed_features(config)
        if config.use_latent and dataset_meta is not None:  # to be trained
            check_latents(config, dataset_meta)
        super().__init__(config, dataset_stats, dataset_meta)
        if world_model is not None:
            # Laid out like the images it gets: else each decision copies all of its weights, most of its time.
            self.world_model = world_model.requires_grad_(False).eval()
            self.world_model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # its stub lacks it
        if config.scales_latents:
            self.latent_scaling = Affine(config.latent_dim)
            if dataset_stats is not None:
                self.latent_scaling.set_standard(
                    stat(dataset_stats, OBS_LATENT, "mean"), stat(dataset_stats, OBS_LATENT, "std")
                )
        if config.use_environment_state:
            self.env_state_scaling = Affine(config.env_state_dim)
            if dataset_stats is not None:
                self.env_state_scaling.set_standard(
                    stat(dataset_stats, OBS_ENV_STATE, "mean"), stat(dataset_stats, OBS_ENV_STATE, "std")
                )
        self.reset()

    @property
    def task_offset(self) -> int:
        """The one-hot task id follows the latent."""
        return self.config.latent_dim

    def train(self, mode: bool = True) -> "LatentPolicy":
        """Switch training mode; the frozen world model stays in evaluation mode.

        LeRobot does so at every step, for which the many modules of the world model are passed over.
        """
        self.training = mode
        for name, module in self.named_children():
            if name != "world_model":
                module.train(mode)
        return self

    def observation(
        self, state: Tensor, tasks: Tensor, latent: Tensor | None, env_state: Tensor | None = None
    ) -> Tensor:
        """Join the networks' input.

        Args:
            state: Proprioception in the dataset's units, (B, P).
            tasks: One-hot task ids, (B, N).
            latent: s_t, (B, L); None with `use_latent=false`.
            env_state: The simulator's full state, (B, F); given with `use_environment_state`.

        Returns:
            [latent, one-hot task, scaled proprioception, scaled full state], (B, O).
        """
        parts = [tasks, self.state_scaling(state)]
        if latent is not None:
            parts.insert(0, self.latent_scaling(latent) if self.config.scales_latents else latent)
        if env_state is not None:
            parts.append(self.env_state_scaling(env_state))
        return torch.cat(parts, dim=-1)

    def observation_at(self, batch: dict[str, Any], tasks: Tensor, t: int | None = None) -> Tensor:
        """`observation` from a training batch.

        Args:
            batch: Frames (B, ...), or windows of them (B, T, ...).
            tasks: One-hot task ids, (B, N).
            t: Which frame of the windows; None where the batch holds frames.

        Returns:
            (B, O).
        """

        def frame(key: str) -> Tensor:
            return batch[key] if t is None else batch[key][:, t]

        return self.observation(
            frame(OBS_STATE),
            tasks,
            frame(OBS_LATENT) if self.config.use_latent else None,
            frame(OBS_ENV_STATE) if self.config.use_environment_state else None,
        )

    def training_inputs(self, batch: dict[str, Any]) -> tuple[Tensor, ...]:
        """What the loss is taken of, from a training batch: a row for each of its samples, (B, ...) each."""
        raise NotImplementedError

    def loss(self, *inputs: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The scalar loss of some rows of `training_inputs`, and its parts by name: detached scalars."""
        raise NotImplementedError

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """The loss of a training batch, as `training_inputs` describes it.

        Returns:
            The scalar loss and its parts by name.

        Raises:
            ValueError: In training, with several updates in a step: `lerobot-wm train` makes them, in this one's place.
        """
        if self.training and self.config.updates_per_step > 1:
            raise ValueError(
                f"--policy.updates_per_step={self.config.updates_per_step} is for lerobot-wm train, which takes the "
                "flags of lerobot-train: train by it, or leave the flag out (of a policy that was trained with it: "
                "--policy.updates_per_step=1)."
            )
        loss, parts = self.loss(*self.training_inputs(batch))
        return loss, logged(parts)

    def reset(self) -> None:
        """Forget the episode: the next call of `select_action` starts the filter anew."""
        super().reset()
        self._filter_state: LatentState | None = None
        self._prev_action: Tensor | None = None
        # What lerobot-eval gathers after every step and joins along dim 2, with `save_predicted_video`.
        self.last_predicted_latents: Tensor | None = None

    def act(self, state: Tensor, tasks: Tensor, latent: Tensor | None, env_state: Tensor | None) -> Tensor:
        """The policy's mean action, clipped to the dataset's range, in its units: (B, A). Arguments: `observation`."""
        mean = self.actor_mean(self.observation(state, tasks, latent, env_state))
        return self.action_scaling.inverse(mean.clamp(-1, 1))

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Filter the new image and act on the state: the policy's mean action, clipped, and `action_noise`.

        Args:
            batch: Each camera (B, C, H, W) in [0, 1], `observation.state` (B, P), `task` (B strings), and
                `observation.environment_state` (B, F) with `use_environment_state`.
            **kwargs: Not used; LeRobot passes options of other policies.

        Returns:
            Actions in the dataset's units, (B, A).

        Raises:
            ValueError: A camera is missing or has another size than in training, the task is unknown, or a
                state is missing.
        """
        if self.training:  # no dropout, as LeRobot's policies act
            self.eval()
        check_observation(self.config, batch)
        state = batch[OBS_STATE]
        latent = self._filter(batch) if self.config.use_latent else None
        env_state = self._env_state(batch) if self.config.use_environment_state else None
        tasks = self.one_hot_tasks(batch, state.shape[0])
        self._prev_action = self.with_noise(self.act(state, tasks, latent, env_state), batch)
        return self._prev_action

    def decode_predicted_latents(self, frames: Tensor) -> Tensor:
        """The video of a rollout, (T, H, W, C) uint8; LeRobot joins its `last_predicted_latents` to (1, C, T, H, W)."""
        return frames[0].permute(1, 2, 3, 0)

    def _filter(self, batch: dict[str, Any]) -> Tensor:
        """Advance the filter by one frame and return s_t, (B, L)."""
        images = camera_images(self.config, batch)  # (B, C, H, W)
        # LeRobot gives no batch size at reset: the state is made when the first frame shows it.
        if self._prev_action is None or self._prev_action.shape[0] != images.shape[0]:
            self._filter_state = None
            self._prev_action = images.new_zeros(images.shape[0], self.config.action_dim)
        # In float32, whatever evaluates: so are the latents that the policy was trained on. (On a GPU LeRobot's own
        # loops have its products computed in TF32, which ours do not.)
        with torch.autocast(images.device.type, enabled=False):
            states = self.world_model.observe(
                images[:, None], self._prev_action[:, None], self._filter_state, batch[OBS_STATE][:, None]
            )
        self._filter_state = states.last()
        if self.config.save_predicted_video:
            expected = self.world_model.expected_images(self._filter_state)
            self.last_predicted_latents = self._expected_and_seen(expected, images)
        return self._filter_state.latent

    def _expected_and_seen(self, expected: Tensor, images: Tensor) -> Tensor:
        """What the world model expected to see, and on its right what it saw.

        They are pictures already: one of LeRobot's videos shows a whole batch, and it decodes latents alone.

        Args:
            expected: Its `expected_images`, (B, K·C, H, W) in [0, 1].
            images: o_t, (B, K·C, H, W) in [0, 1].

        Returns:
            One pair for each of the B environments, as tiles of one picture: (1, C, 1, H', W') uint8.
        """
        both = (side_by_side(image, len(self.config.cameras)) for image in (expected, images))
        pairs = torch.cat(list(both), dim=-1)
        grid = make_grid(pairs, nrow=math.ceil(pairs.shape[0] ** 0.5))  # (C, H', W')
        return (255 * grid).round().byte()[None, :, None]

    def _env_state(self, batch: dict[str, Any]) -> Tensor:
        self.config.check_environment_state(batch)
        return batch[OBS_ENV_STATE]

"""A policy on the latents of a frozen world model: in training it reads them, at test time it filters images."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.factory import get_policy_class
from torch import Tensor, nn
from torchvision.utils import make_grid

from lerobot_wm.constants import OBS_ENV_STATE, OBS_LATENT, OBS_SHIFTED_LATENTS
from lerobot_wm.data.latents import weights_fingerprint
from lerobot_wm.nn.images import camera_images, side_by_side
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.policies.common.acting_policy import ActingPolicy
from lerobot_wm.policies.common.checkpoint import read_config, split_revision
from lerobot_wm.policies.common.features import Statistics, join_vectors, statistics
from lerobot_wm.policies.latent.config import LatentPolicyConfig, open_world_model
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.policies.world_model.policy import WorldModelPolicy
from lerobot_wm.world_model.interface import LatentModel, LatentState


class LatentPolicy(ActingPolicy):
    """Base of `wm_bc` and `wm_iql`: holds the frozen world model, or an encoder in its place, and the filter's state.

    Subclasses make the heads in `build`, and define `actor_chunk` and `compute_loss`.
    """

    config: LatentPolicyConfig
    has_memory = True  # the filter's
    world_model: LatentModel  # with `use_latent`

    def build(self) -> None:
        """Make the scalings and the world model, whose weights come from its checkpoint or the policy's."""
        super().build()
        config = self.config
        if config.world_model is not None:
            made = get_policy_class(config.world_model.type)(config.world_model)
            self.world_model = made.world_model.requires_grad_(not config.freezes_world_model).eval()
            # The layout of its images. Otherwise each decision copies all weights, which takes most of its time.
            self.world_model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # its stub lacks it
        if config.scales_latents:
            self.latent_scaling = Affine(config.latent_dim)
        if config.use_environment_state:
            self.env_state_scaling = Affine(config.env_state_dim)
        self.reset()

    def fit_dataset(self, stats: Statistics, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Load the world model's weights, and set the scalings."""
        config = self.config
        if config.use_latent:
            assert config.world_model_path is not None  # checked with the features
            with torch.random.fork_rng(devices=[]):
                encoder = load_encoder(config.world_model_path).world_model
            self.world_model.load_state_dict(encoder.state_dict())
            config.world_model_fingerprint = encoder_fingerprint(encoder)
            if config.reads_stored_latents:
                config.check_latents(dataset_meta)
        super().fit_dataset(stats, dataset_meta)
        if config.scales_latents:
            mean, std = statistics(stats, OBS_LATENT, "mean", "std")
            self.latent_scaling.set_standard(mean[-config.latent_dim :], std[-config.latent_dim :])
        if config.use_environment_state:
            self.env_state_scaling.set_standard(*statistics(stats, OBS_ENV_STATE, "mean", "std"))

    def continue_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Also check that the dataset's latents are of this world model."""
        super().continue_training(dataset_meta)
        if self.config.reads_stored_latents:
            self.config.check_latents(dataset_meta)

    @property
    def observation_dim(self) -> int:
        """O, the size of the heads' input."""
        return self.config.observation_dim

    @property
    def task_start(self) -> int:
        """The one-hot task id follows the latent."""
        return self.config.latent_dim

    def train(self, mode: bool = True) -> "LatentPolicy":
        """Switch training mode; the world model stays in evaluation mode, and filters as it will at test time."""
        self.training = mode
        for name, module in self.named_children():
            if name != "world_model":
                module.train(mode)
        return self

    def named_modules(
        self, memo: set[nn.Module] | None = None, prefix: str = "", remove_duplicate: bool = True
    ) -> Iterator[tuple[str, nn.Module]]:
        """The policy's modules without the frozen world model, so that `parameters` gives those of its own networks.

        LeRobot walks through them at every training step, and the world model has many times more than the rest. What
        goes through children is not affected: state dict, device, copies.
        """
        memo = set() if memo is None else memo
        world_model = getattr(self, "world_model", None)
        if world_model is not None and self.config.freezes_world_model:
            memo.add(world_model)
        return super().named_modules(memo, prefix, remove_duplicate)

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
        inputs = [tasks, self.proprioception(state)]
        if latent is not None:
            latent = latent[..., -self.config.latent_dim :]
            inputs.insert(0, self.latent_scaling(latent) if self.config.scales_latents else latent)
        if env_state is not None:
            inputs.append(self.env_state_scaling(env_state))
        return torch.cat(inputs, dim=-1)

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
            self.state_at(batch, t),
            tasks,
            self._latent(frame) if self.config.use_latent else None,
            frame(OBS_ENV_STATE) if self.config.use_environment_state else None,
        )

    def _latent(self, frame: Callable[[str], Tensor]) -> Tensor:
        """s_t of a training batch, (B, L), given its features at t; with `random_crop_pad`, of shifted images."""
        if not (self.training and self.config.reads_stored_latents and self.config.random_crop_pad):
            return frame(OBS_LATENT)
        shifted = frame(OBS_SHIFTED_LATENTS)  # (B, K, L)
        rows = torch.arange(len(shifted), device=shifted.device)
        return shifted[rows, torch.randint(shifted.shape[1], rows.shape, device=shifted.device)]

    def reset(self) -> None:
        """Forget the episode: the next call of `select_action` starts a new filter."""
        super().reset()
        self._filter_state: LatentState | None = None
        self._prev_action: Tensor | None = None
        # With `save_predicted_video`, lerobot-eval collects this after every step and joins it along dim 2.
        self.last_predicted_latents: Tensor | None = None

    def observe(self, batch: dict[str, Any], state: Tensor) -> Tensor:
        """Filter the new image; join s_t, the one-hot task, proprioception and full state: (B, O)."""
        latent = self._filter(batch) if self.config.use_latent else None
        env_state = batch[OBS_ENV_STATE] if self.config.use_environment_state else None
        return self.observation(state, self.one_hot_tasks(batch, len(state)), latent, env_state)

    def executed(self, action: Tensor) -> None:
        """Tell the filter a_{t-1}, (B, A) in the dataset's units."""
        self._prev_action = action.to(self.action_scaling.offset.device)

    def decode_predicted_latents(self, frames: Tensor) -> Tensor:
        """The video of a rollout, (T, H, W, C) uint8; LeRobot joins its `last_predicted_latents` to (1, C, T, H, W)."""
        return frames[0].permute(1, 2, 3, 0)

    def _filter(self, batch: dict[str, Any]) -> Tensor:
        """Advance the filter by one frame and return s_t, (B, L)."""
        images = camera_images(batch, self.config.cameras, self.config.image_size)  # (B, C, H, W)
        # LeRobot gives no batch size at reset, so the state is made when the first frame shows it.
        previous = self._prev_action if self.config.use_memory else None
        if previous is None or previous.shape[0] != images.shape[0]:
            self._filter_state = None
            previous = images.new_zeros(images.shape[0], self.config.action_dim)
        assert self.config.world_model is not None
        proprio = join_vectors(batch, self.config.world_model.proprio_vectors)
        # In float32 even under autocast, as the latents that the policy was trained on. (On a GPU, LeRobot's own loops
        # compute float32 products in TF32; ours do not.)
        with torch.autocast(images.device.type, enabled=False):
            states = self.world_model.observe(
                images[:, None],
                previous[:, None],
                self._filter_state,
                None if proprio is None else proprio[:, None],
            )
        self._filter_state = states.last()
        if self.config.save_predicted_video:
            expected = self.world_model.expected_images(self._filter_state)
            self.last_predicted_latents = self._expected_and_seen(expected, images)
        return self._filter_state.latent

    def _expected_and_seen(self, expected: Tensor, images: Tensor) -> Tensor:
        """What the world model expected to see, and to its right what it saw.

        They are decoded already: one of LeRobot's videos shows a whole batch, while it would decode single latents.

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


type EncoderPolicy = WorldModelPolicy | LatentPolicy


def load_encoder(path: str) -> EncoderPolicy:
    """Load a checkpoint with a world model, which is the policy's `world_model`.

    Args:
        path: Folder of a checkpoint of wm_rssm, frozen_backbone or another world model's type, or of a policy on
            latents, which contains its world model; or its Hub id: user/name, or user/name@revision.

    Raises:
        FileNotFoundError: A file of the checkpoint is missing.
        CheckpointError: It is damaged, or holds no world model.
    """
    open_world_model(path)
    name, revision = split_revision(path)
    config = read_config(name, revision)
    return get_policy_class(config.type).from_pretrained(name, config=config, revision=revision)


def encoder_config(policy: EncoderPolicy) -> WorldModelConfig:
    """The configuration of the world model that a policy holds."""
    config = policy.config.world_model if isinstance(policy, LatentPolicy) else policy.config
    assert config is not None  # a policy with a world model
    return config


def encoder_fingerprint(model: LatentModel, **further: Any) -> str:
    """Hash of an encoder's weights and `encoding_settings`, and of what else (`further`) decides its latents."""
    return weights_fingerprint(model, {**model.encoding_settings, **further})

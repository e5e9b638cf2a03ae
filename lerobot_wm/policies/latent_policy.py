"""A policy on the latents of a frozen world model: in training it reads them, at test time it filters images."""

from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import ACTION, OBS_LATENT, OBS_STATE, TASK
from lerobot_wm.data.fingerprint import weights_fingerprint
from lerobot_wm.data.latents import LatentRecord
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.policies.features import stat
from lerobot_wm.policies.latent_config import LatentPolicyConfig
from lerobot_wm.policies.pretrained import StrictPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy, resize_images
from lerobot_wm.world_model.model import WorldModel
from lerobot_wm.world_model.rssm import RSSMState


class LatentPolicy(StrictPolicy):
    """Base of `wm_bc` and `wm_iql`: holds the frozen world model, the task list and the filter's state.

    Subclasses define `actor_mean` and `forward`.
    """

    config: LatentPolicyConfig

    def __init__(
        self,
        config: LatentPolicyConfig,
        dataset_stats: dict[str, dict[str, Any]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        super().__init__(config)
        world_model = None
        if dataset_meta is not None:  # to be trained
            if not config.tasks:  # made new, not loaded from a checkpoint
                config.tasks = [str(task) for task in dataset_meta.tasks.index]
                if config.use_latent:
                    world_model = _adopt_world_model(config)
                config.input_features = _deployed_features(config)
            if config.use_latent:
                _check_latents(config, dataset_meta)
        config.validate_features()
        if config.use_latent:
            assert config.rssm is not None  # filled by _adopt_world_model or by the checkpoint
            self.world_model = WorldModel(config.rssm) if world_model is None else world_model
            self.world_model.requires_grad_(False)
        self.state_scaling = Affine(config.state_dim)
        self.action_scaling = Affine(config.action_dim)
        if dataset_stats is not None:  # a checkpoint's own values replace these when it is loaded
            self.state_scaling.set_standard(
                stat(dataset_stats, OBS_STATE, "mean"), stat(dataset_stats, OBS_STATE, "std")
            )
            self.action_scaling.set_range(
                stat(dataset_stats, ACTION, "min"), stat(dataset_stats, ACTION, "max")
            )
        self._task_index = {task: i for i, task in enumerate(config.tasks)}
        self.reset()

    def actor_mean(self, observation: Tensor) -> Tensor:
        """The policy's action (B, A), scaled to [-1, 1], for observations (B, O)."""
        raise NotImplementedError

    def train(self, mode: bool = True) -> "LatentPolicy":
        """Switch training mode; the frozen world model stays in evaluation mode."""
        super().train(mode)
        if self.config.use_latent:
            self.world_model.eval()
        return self

    def observation(self, state: Tensor, tasks: Tensor, latent: Tensor | None) -> Tensor:
        """Join the networks' input.

        Args:
            state: Proprioception in the dataset's units, (B, P).
            tasks: One-hot task ids, (B, N).
            latent: s_t, (B, D+S); None for the blind control.

        Returns:
            [latent, one-hot task, scaled proprioception], (B, O).
        """
        parts = [tasks, self.state_scaling(state)]
        return torch.cat(parts if latent is None else [latent, *parts], dim=-1)

    def one_hot_tasks(self, batch: dict[str, Any], batch_size: int) -> Tensor:
        """One-hot task ids (B, N) from the batch's task strings; one known task needs no string.

        Raises:
            ValueError: A task string is missing or is not one the policy was trained on.
        """
        known = self.config.tasks
        names = [known[0]] * batch_size if len(known) == 1 else batch.get(TASK)
        if names is None:
            raise ValueError(
                f"The batch has no '{TASK}' strings; this policy knows {len(known)} tasks: {known}."
            )
        unknown = set(names) - self._task_index.keys()
        if unknown:
            raise ValueError(
                f"Unknown task {sorted(unknown)}; this policy was trained on {known}. Use one of these strings, or "
                "train a policy on a dataset that holds the new task."
            )
        index = torch.tensor(
            [self._task_index[name] for name in names], device=self.state_scaling.offset.device
        )
        return nn.functional.one_hot(index, len(known)).float()

    def reset(self) -> None:
        """Forget the episode: the next call of `select_action` starts the filter anew."""
        self._filter_state: RSSMState | None = None
        self._prev_action: Tensor | None = None

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Filter the new image and act on the state: the policy's mean action, clipped to the dataset's range.

        Args:
            batch: The camera (B, C, H, W) in [0, 1], `observation.state` (B, P), `task` (B strings).
            **kwargs: Not used; LeRobot passes options of other policies.

        Returns:
            Actions in the dataset's units, (B, A).

        Raises:
            ValueError: The image has another size than in training, or the task is unknown.
        """
        state = batch[OBS_STATE]
        latent = self._filter(batch) if self.config.use_latent else None
        observation = self.observation(state, self.one_hot_tasks(batch, state.shape[0]), latent)
        action = self.action_scaling.inverse(self.actor_mean(observation).clamp(-1, 1))
        self._prev_action = action
        return action

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """`select_action` as a chunk of one: (B, 1, A)."""
        return self.select_action(batch, **kwargs)[:, None]

    def _filter(self, batch: dict[str, Any]) -> Tensor:
        """Advance the filter by one frame and return s_t, (B, D+S)."""
        key = self.config.image_key
        assert key is not None
        image = batch[key]
        expected = tuple(self.config.input_features[key].shape)
        if tuple(image.shape[1:]) != expected:
            raise ValueError(
                f"'{key}' is {tuple(image.shape[1:])}, the world model was trained on {expected} "
                f"(C, H, W): set the camera or environment to {expected[1]}x{expected[2]} "
                f"(--env.image_size={expected[1]} for metaworld_mt)."
            )
        # LeRobot gives no batch size at reset: the state is made when the first frame shows it.
        if self._prev_action is None or self._prev_action.shape[0] != image.shape[0]:
            self._filter_state = None
            self._prev_action = image.new_zeros(image.shape[0], self.config.action_dim)
        proprio = batch[OBS_STATE][:, None] if self.world_model.config.use_proprio else None
        states = self.world_model.observe(
            resize_images(image)[:, None], self._prev_action[:, None], self._filter_state, proprio
        )
        self._filter_state = states.last()
        return self._filter_state.latent


def _check_latents(config: LatentPolicyConfig, dataset_meta: LeRobotDatasetMetadata) -> None:
    """Refuse a dataset without latents or with those of another world model."""
    if OBS_LATENT not in dataset_meta.features:
        raise ValueError(
            f"{dataset_meta.repo_id} has no '{OBS_LATENT}'. Encode it with the world model first (`lerobot-wm encode "
            f"--world_model_path=... --dataset.repo_id={dataset_meta.repo_id} ...`), or train with `lerobot-wm train`, "
            "which does so by itself."
        )
    record = LatentRecord.read(Path(dataset_meta.root))
    record.check_world_model(config.world_model_fingerprint, config.world_model_path)


def _adopt_world_model(config: LatentPolicyConfig) -> WorldModel:
    """Load the world model and note its sizes in `config`."""
    if config.world_model_path is None:
        raise ValueError(
            f"--policy.type={config.type} needs --policy.world_model_path=<folder or Hub id of a wm_rssm checkpoint>."
        )
    world_model_policy = WMRSSMPolicy.from_pretrained(config.world_model_path)
    world_model = world_model_policy.world_model
    config.rssm = world_model_policy.config.rssm
    config.image_key = world_model_policy.config.image_key
    config.input_features[config.image_key] = world_model_policy.config.input_features[config.image_key]
    config.world_model_fingerprint = weights_fingerprint(world_model)
    return world_model


def _deployed_features(config: LatentPolicyConfig) -> dict[str, PolicyFeature]:
    """What the policy reads at test time: the world model's camera and proprioception, not the stored latent."""
    wanted = {OBS_STATE} if config.image_key is None else {OBS_STATE, config.image_key}
    features = {key: feature for key, feature in config.input_features.items() if key in wanted}
    if OBS_STATE not in features or features[OBS_STATE].type is not FeatureType.STATE:
        raise ValueError(f"The dataset has no '{OBS_STATE}'; it has {sorted(config.input_features)}.")
    return features

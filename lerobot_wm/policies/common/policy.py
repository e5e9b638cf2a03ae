"""The base classes of all our policies: how one is created, loaded, trained and saved, and what acting ones share."""

import logging
import zlib
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, NoReturn, Self

import torch
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from safetensors import SafetensorError
from torch import Tensor, nn

from lerobot_wm.constants import ACTION, OBS_IMAGE, OBS_STATE, TASK
from lerobot_wm.data.tables import frame_values, relative_to_state
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.nn.normalize import Affine
from lerobot_wm.policies.common.card import TrainingData, model_card
from lerobot_wm.policies.common.checkpoint import WHOLE, CheckpointError, cut_short, not_finite, read_config
from lerobot_wm.policies.common.checks import (
    check_has_stats,
    check_names,
    check_sizes,
    current_names,
    dataset_cameras,
    names_before,
)
from lerobot_wm.policies.common.config import (
    ActingConfig,
    PolicyConfig,
    check_tasks,
    feature_dim,
    tasks_to_learn,
    train_new,
)
from lerobot_wm.policies.common.divergence import check_finite, check_finite_weights

logger = logging.getLogger(__name__)

Statistics = Mapping[str, Mapping[str, Any]]

# Options of the Hub that `from_pretrained` passes on for each file.
_HUB_OPTIONS = ("revision", "token", "cache_dir", "force_download", "local_files_only")
_RANGE_TOLERANCE = 0.05  # share of a dataset's range that noise in a few frames adds
_WHITE = 1.01  # resizing and floating point may exceed 1 a little; a camera's bytes exceed this


class BasePolicy(PreTrainedPolicy):
    """A LeRobot policy that is built from its configuration alone, and whose checkpoints must match exactly.

    A new policy is created for a dataset: the configuration takes sizes and tasks from it, `build` makes the networks,
    `fit_dataset` sets what the dataset's statistics decide. A loaded policy is built from the configuration in its
    checkpoint, and its weights and scalings stay; `continue_training` prepares it for a dataset.

    Subclasses define `build` and `compute_loss`, and extend `fit_dataset` and `prepare_training`.
    """

    # LeRobot requires both of every class; each policy type sets its own.
    config_class = PolicyConfig
    name = "base"
    config: PolicyConfig

    def __init__(
        self,
        config: PolicyConfig,
        dataset_stats: Statistics | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> None:
        """Create a policy; without a dataset its scalings are those of random numbers, until weights are loaded.

        Args:
            config: Its settings; with a dataset, sizes and tasks in it are replaced by the dataset's.
            dataset_stats: The dataset's statistics; None takes those of `dataset_meta`.
            dataset_meta: The dataset to train a new policy on.
        """
        super().__init__(config)
        if dataset_meta is not None:
            check_names(dataset_meta)
            check_has_stats(dataset_meta)
            config.fill_from_dataset(dataset_meta)
        config.validate_features()
        self.build()
        if dataset_meta is not None:
            self.fit_dataset(dataset_stats or dataset_meta.stats, dataset_meta)
            self.prepare_training(dataset_meta)

    def build(self) -> None:
        """Make the networks and buffers from the configuration alone."""
        raise NotImplementedError

    def fit_dataset(self, stats: Statistics, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Set what a new policy's dataset decides and its checkpoints keep, such as scalings."""

    def prepare_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Add what only training on this dataset needs, to a new policy and to a loaded one."""

    def continue_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Prepare a loaded policy for training on a dataset, whose cameras may have other sizes than before."""
        self.config.input_features |= dataset_cameras(self.config, dataset_meta)
        self.prepare_training(dataset_meta)

    def compute_loss(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, Tensor]]:
        """The scalar loss of a training batch, and its parts by name: detached scalars."""
        raise NotImplementedError

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, dict[str, float]]:
        """The training loss, and its parts as numbers for the log.

        Args:
            batch: See `compute_loss` of the policy type.

        Raises:
            DivergenceError: The loss is NaN or infinite.
        """
        loss, parts = self.compute_loss(self._with_axes(batch))
        scalars = {**parts, "loss": loss.detach()}
        # One transfer from the device for all of them.
        numbers = dict(zip(scalars, torch.stack(list(scalars.values())).tolist(), strict=True))
        check_finite(numbers, self.config, batch)
        del numbers["loss"]
        return loss, numbers

    def _with_axes(self, batch: dict[str, Any]) -> dict[str, Any]:
        """A training batch whose vectors of one number have the axis that LeRobot drops: (B, 1) or (B, T, 1)."""
        config = self.config
        restored = {}
        for key, feature in {**config.input_features, **config.output_features}.items():
            if tuple(feature.shape) == (1,) and key in batch:
                deltas = config.action_delta_indices if key == ACTION else config.observation_delta_indices
                restored[key] = batch[key].reshape(-1, *([] if deltas is None else [len(deltas)]), 1)
        return batch | restored

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: Any,
        *,
        config: PreTrainedConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        strict: bool = True,
        **kwargs: Any,
    ) -> Self:
        """Load a checkpoint from a folder or the Hub.

        It keeps its weights, and the statistics that scale actions and proprioception: the weights were fitted to them.

        Args:
            pretrained_name_or_path: Folder or Hub id.
            config: Its configuration with changes; None takes the checkpoint's.
            dataset_meta: The dataset to continue training on; None to act.
            strict: Whether weights must match exactly.
            **kwargs: LeRobot's, such as `revision`.

        Raises:
            FileNotFoundError: The configuration or the weights are missing.
            CheckpointError: The checkpoint is of another type or damaged, or its weights do not match `config`.
            ValueError: `config` changes what the weights depend on, or sizes of the dataset or environment differ.
        """
        hub = {name: kwargs[name] for name in _HUB_OPTIONS if name in kwargs}
        saved = read_config(pretrained_name_or_path, **hub)
        if not isinstance(saved, cls.config_class):
            raise CheckpointError(
                f"{pretrained_name_or_path} is a {saved.type}, not a {cls.name}: give a checkpoint of {cls.name}, or "
                f"load it with --policy.type={saved.type}."
            )
        if config is None:
            config = deepcopy(saved)
        assert isinstance(config, cls.config_class)
        config.check_unchanged(saved)
        if dataset_meta is not None:
            check_has_stats(dataset_meta)
            check_sizes(saved, dataset_meta, current_names())
        # The dataset's statistics, which LeRobot passes, are for new policies.
        kwargs.pop("dataset_stats", None)
        policy = super().from_pretrained(pretrained_name_or_path, config=config, strict=strict, **kwargs)
        if dataset_meta is not None:
            policy.continue_training(dataset_meta)
            policy.to(config.device)
        return policy

    @classmethod
    def _load_as_safetensor(cls, model: Self, model_file: str, map_location: str, strict: bool) -> Self:
        file = Path(model_file)
        if not file.is_file():
            raise FileNotFoundError(f"{file} is missing: {WHOLE}.")
        try:
            model = super()._load_as_safetensor(model, model_file, map_location, strict)
        except SafetensorError as error:
            raise cut_short(file, error) from error
        except RuntimeError as error:
            raise CheckpointError(
                f"{file} does not fit the networks of this {cls.name}: {error}. If a --policy flag changes the "
                f"networks, leave it out, or {train_new(model.config)}. Otherwise config.json is of another "
                f"checkpoint: {WHOLE}."
            ) from error
        bad = [name for name, tensor in model.state_dict().items() if not torch.isfinite(tensor).all()]
        if bad:
            raise not_finite(file, bad)
        return model

    def _save_pretrained(self, save_directory: Path, *args: Any, **kwargs: Any) -> None:
        """Save as LeRobot does, if all weights are finite, without the revision of the checkpoint it started from.

        LeRobot would look for that revision in the new policy's repository.

        Raises:
            DivergenceError: A weight is NaN or infinite.
        """
        check_finite_weights(self, self.config)
        revision, self.config.pretrained_revision = self.config.pretrained_revision, None
        try:
            super()._save_pretrained(save_directory, *args, **kwargs)
        finally:
            self.config.pretrained_revision = revision

    def wrap_with_peft(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse adapters (`--peft.*`): LeRobot loads their base with the settings of the trained policy.

        Raises:
            ValueError: Always; says what to do instead.
        """
        raise ValueError(
            f"--peft: {self.name} takes no adapters. Its networks are small: leave the --peft flags out, and "
            "--policy.path trains all weights."
        )

    def generate_model_card(
        self,
        *args: Any,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ) -> ModelCard:
        """The card that LeRobot publishes with a policy after training; its other arguments are in `cfg`."""
        data = None if dataset_meta is None else TrainingData.of(dataset_meta)
        return model_card(self.config, self.config.repo_id or self.name, cfg, data)


class ActingPolicy(BasePolicy):
    """Base of the policies that choose actions: tasks as one-hot ids, scaled proprioception and actions, action noise.

    Subclasses also define `observation_networks`, `task_start`, `actor_mean` and `select_action`.
    """

    config: ActingConfig

    def build(self) -> None:
        """Make the scalings."""
        self.state_scaling = Affine(self.config.state_dim)
        self.action_scaling = Affine(self.config.action_dim)
        self._action_noise = ActionNoise(self.config.action_noise)

    def fit_dataset(self, stats: Statistics, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Scale proprioception to unit variance and actions to [-1, 1]; choose what is relative to the state."""
        self.state_scaling.set_standard(*joined_statistics(stats, self.config.state_vectors, "mean", "std"))
        self._choose_relative_actions(dataset_meta)
        self.action_scaling.set_range(*self._action_range(stats, dataset_meta))

    def _choose_relative_actions(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        config = self.config
        reads_state = OBS_STATE in config.state_vectors
        size = feature_dim(config.input_features, OBS_STATE) if reads_state else 0
        config.relative_indices = []
        if config.relative_actions is None and reads_state:
            config.relative_indices = relative_to_state(dataset_meta, _state_column())
        elif config.relative_actions:
            if size != config.action_dim:
                raise ValueError(
                    f"--policy.relative_actions=true: the action has {config.action_dim} numbers and the "
                    f"'{OBS_STATE}' that the policy reads {size}; expected as many. Leave the flag out."
                )
            config.relative_indices = list(range(size))
        if config.relative_indices:
            logger.info(
                "%d of the action's %d numbers are targets for the state, and are learned relative to it "
                "(--policy.relative_actions=false learns them as recorded).",
                len(config.relative_indices),
                config.action_dim,
            )

    def _action_range(self, stats: Statistics, dataset_meta: LeRobotDatasetMetadata) -> tuple[Tensor, Tensor]:
        """Lowest and highest actions (A,) of a dataset, as the heads learn them."""
        low, high = (value.clone() for value in statistics(stats, ACTION, "min", "max"))  # (A,)
        chosen = self.config.relative_indices
        if chosen:
            action, state = (
                frame_values(dataset_meta, key).view(-1, self.config.action_dim)
                for key in (ACTION, _state_column())
            )  # (N, A)
            relative = action[:, chosen] - state[:, chosen]  # (N, R)
            low[chosen], high[chosen] = relative.amin(0), relative.amax(0)
        return low, high

    def scaled(self, action: Tensor, state: Tensor) -> Tensor:
        """Actions (B, A) as the heads learn them, given proprioception (B, P) at the same frames."""
        return self.action_scaling(self._minus_state(action, state, -1))

    def unscaled(self, scaled: Tensor, state: Tensor) -> Tensor:
        """Undo `scaled`."""
        return self._minus_state(self.action_scaling.inverse(scaled), state, 1)

    def _minus_state(self, action: Tensor, state: Tensor, sign: int) -> Tensor:
        chosen = self.config.relative_indices
        if not chosen:
            return action
        index, of_state = (
            torch.tensor(indices, device=action.device)
            for indices in (chosen, self.config.relative_state_indices)
        )
        return action.index_add(-1, index, state[..., of_state].to(action.dtype), alpha=sign)

    def state_at(self, batch: dict[str, Any], t: int | None = None) -> Tensor:
        """Proprioception of a batch in the dataset's units.

        Args:
            batch: Frames (B, ...), or windows of them (B, T, ...).
            t: Which frame of the windows; None where the batch holds frames.

        Returns:
            (B, P); P is 0 for a policy without proprioception.
        """
        frames = {key: batch[key] if t is None else batch[key][:, t] for key in self.config.state_vectors}
        state = join_vectors(frames, self.config.state_vectors)
        return self.state_scaling.offset.new_zeros(self.batch_size(batch), 0) if state is None else state

    def batch_size(self, batch: dict[str, Any]) -> int:
        """B of a batch, in training or at test time."""
        keys = (*self.config.input_features, ACTION)
        return next(len(batch[key]) for key in keys if isinstance(batch.get(key), Tensor))

    def scaled_actions(self, batch: dict[str, Any]) -> Tensor:
        """A training batch's actions (B, A) as the heads learn them."""
        has_windows = self.config.observation_delta_indices is not None  # frames t and t+1
        return self.scaled(batch[ACTION], self.state_at(batch, 0 if has_windows else None))

    def continue_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Also learn the dataset's new tasks."""
        super().continue_training(dataset_meta)
        tasks = tasks_to_learn(dataset_meta)
        self.config.trained_tasks = list(dict.fromkeys([*self.config.known_tasks, *tasks]))
        self.add_tasks(tasks)
        self.warn_if_actions_out_of_range(dataset_meta)

    def warn_if_actions_out_of_range(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Warn of actions in a dataset that this policy, scaled as in its first training, cannot command."""
        low, high = self._action_range(dataset_meta.stats or {}, dataset_meta)  # (A,), on the CPU
        ends = (torch.full_like(self.action_scaling.offset, end) for end in (-1.0, 1.0))
        lowest, highest = (self.action_scaling.inverse(end).cpu() for end in ends)  # (A,)
        tolerance = _RANGE_TOLERANCE * (high - low)
        outside = (low < lowest - tolerance) | (high > highest + tolerance)
        for i in torch.nonzero(outside).flatten().tolist():
            logger.warning(
                "Number %d of the actions ranges from %.3g to %.3g in %s; this policy was first trained on %.3g to "
                "%.3g and cannot command the rest. If that matters, train a new --policy.type=%s on both datasets.",
                *(i, low[i], high[i], dataset_meta.repo_id, lowest[i], highest[i], self.config.type),
            )

    def observation_networks(self) -> list[MLP]:
        """The networks that read the observation (B, O), and perhaps more after it."""
        raise NotImplementedError

    @property
    def task_start(self) -> int:
        """Index in the observation at which the one-hot task id begins."""
        raise NotImplementedError

    @torch.no_grad()
    def add_tasks(self, tasks: list[str]) -> None:
        """Add tasks after the known ones, with zero weights, so that known tasks are acted on as before.

        Args:
            tasks: Task strings; known ones are skipped.
        """
        new = [task for task in tasks if task not in self.config.tasks]
        if not new:
            return
        for network in self.observation_networks():
            network.insert_inputs(self.task_start + len(self.config.tasks), len(new))
        logger.info("New tasks: %s; known ones: %s", new, self.config.tasks)
        self.config.tasks = [*self.config.tasks, *new]

    def actor_mean(self, observation: Tensor) -> Tensor:
        """The policy's action (B, A), scaled to [-1, 1], for observations (B, O)."""
        raise NotImplementedError

    def reset(self) -> None:
        """Forget the episode; LeRobot calls this between episodes."""
        self._action_noise.reset()

    def act(self, observation: Tensor, state: Tensor) -> Tensor:
        """The policy's mean action, clipped to the dataset's range, in its units.

        Args:
            observation: What the heads read, (B, O).
            state: Proprioception in the dataset's units, (B, P).

        Returns:
            (B, A).
        """
        return self.unscaled(self.actor_mean(observation).clamp(-1, 1), state)

    def with_noise(self, action: Tensor, batch: dict[str, Any]) -> Tensor:
        """Actions (B, A) with `action_noise`, clipped to the dataset's range; `batch` is that of `select_action`."""
        if self.config.action_noise == 0:
            return action
        state = self.state_at(batch)
        noisy = self._action_noise(self.scaled(action, state), batch)  # (B, A)
        return self.unscaled(noisy.clamp(-1, 1), state)

    def one_hot_tasks(self, batch: dict[str, Any], batch_size: int) -> Tensor:
        """One-hot task ids (B, N) from the batch's task strings, or from a single string for all of it.

        A policy that knows one task performs it whatever the string: simulators name tasks in their own words.

        Raises:
            ValueError: A policy of several tasks is given no string, or one that it was not trained on.
        """
        known = self.config.known_tasks
        given = batch.get(TASK) or [""] * batch_size  # lerobot-rollout gives "" when it was given none
        if isinstance(given, str):
            given = [given] * batch_size
        names = [known[0]] * batch_size if len(known) == 1 else given
        if "" in set(names) - set(known):
            raise ValueError(
                f"The batch has no '{TASK}' strings; this policy knows {len(known)} tasks: {known}. Give one of these "
                "strings (--task for lerobot-rollout)."
            )
        check_tasks(self.config, names)
        index = {task: i for i, task in enumerate(self.config.tasks)}
        ids = torch.tensor([index[name] for name in names], device=self.state_scaling.offset.device)
        return nn.functional.one_hot(ids, len(self.config.tasks)).float()

    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """`select_action` as a chunk of one: (B, 1, A)."""
        return self.select_action(batch, **kwargs)[:, None]


def _state_column() -> str:
    """The name that `observation.state` has in the dataset."""
    [name] = names_before([OBS_STATE], current_names())
    return name


def check_observation(config: PolicyConfig, batch: dict[str, Any]) -> None:
    """Check what a policy is shown: each camera (B, C, H, W) in [0, 1], and vectors (B, N) such as `observation.state`.

    Raises:
        ValueError: A feature is missing or has another shape than in training, or images are not in [0, 1].
    """
    config.check_shapes(
        {key: tuple(value.shape[1:]) for key, value in batch.items() if isinstance(value, Tensor)}
    )
    for key in config.cameras:
        image = batch[key]
        if not image.is_floating_point() or image.max() > _WHITE:
            raise ValueError(
                f"'{key}' is {image.dtype} with a maximum of {image.max().item():g}; expected floating-point numbers "
                "in [0, 1]: divide a camera's bytes by 255, as prepare_observation_for_inference of "
                "lerobot.policies.utils does."
            )


class ActionNoise:
    """Gaussian noise on actions, one stream per rollout of a batch, seeded by the rollout's first observation.

    A rollout is therefore repeatable: it does not depend on the other rollouts, their order, or global random numbers.

    Args:
        std: Standard deviation, in the units in which the dataset's actions span [-1, 1].
    """

    def __init__(self, std: float) -> None:
        self.std = std
        self.reset()

    def reset(self) -> None:
        """Forget the streams: the next call begins new rollouts."""
        self._streams: list[torch.Generator] = []

    def __call__(self, action: Tensor, batch: dict[str, Any]) -> Tensor:
        """Add the next step's noise to scaled actions (B, A), given the batch of `select_action`."""
        if len(self._streams) != action.shape[0]:
            self._streams = [torch.Generator().manual_seed(_digest(batch, i)) for i in range(action.shape[0])]
        noise = torch.stack([torch.randn(action.shape[1], generator=stream) for stream in self._streams])
        return action + self.std * noise.to(action)


def _digest(batch: dict[str, Any], i: int) -> int:
    """A number made of every bit of the tensors of row i."""
    digest = 0
    for key in sorted(key for key, value in batch.items() if isinstance(value, Tensor) and value.ndim > 1):
        digest = zlib.crc32(batch[key][i].contiguous().cpu().numpy().tobytes(), digest)
    return digest


def join_vectors(batch: Mapping[str, Tensor], keys: Sequence[str]) -> Tensor | None:
    """Vectors (..., N) of a batch side by side in one; None without any."""
    if not keys:
        return None
    return batch[keys[0]] if len(keys) == 1 else torch.cat([batch[key] for key in keys], dim=-1)


def joined_statistics(stats: Statistics, keys: Sequence[str], *names: str) -> Iterator[Tensor]:
    """`statistics` of vectors that are joined by `join_vectors`; empty without any."""
    for name in names:
        yield torch.cat([torch.empty(0), *(value for key in keys for value in statistics(stats, key, name))])


def statistics(stats: Statistics, key: str, *names: str) -> Iterator[Tensor]:
    """Statistics of a dataset's feature, each as a float32 vector.

    Raises:
        ValueError: The dataset has no such statistic.
    """
    for name in names:
        if name not in stats.get(key, {}):
            if key.startswith(OBS_IMAGE):
                fix = "LeRobot computes it for images at recording only: leave out --policy.rssm.standardize_images"
            else:
                fix = "lerobot-edit-dataset --operation.type=recompute_stats writes a copy of the dataset with it"
            raise ValueError(
                f"The dataset's meta/stats.json has no '{name}' of '{key}', which scales the model's inputs: {fix}."
            )
        yield torch.as_tensor(stats[key][name], dtype=torch.float32).flatten()

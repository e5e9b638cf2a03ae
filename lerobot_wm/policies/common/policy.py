"""The base class of all our policies: how one is created, loaded, trained and saved."""

import logging
import math
from collections.abc import Mapping
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

from lerobot_wm.constants import ACTION
from lerobot_wm.policies.common.card import TrainingData, model_card
from lerobot_wm.policies.common.checkpoint import WHOLE, CheckpointError, cut_short, not_finite, read_config
from lerobot_wm.policies.common.checks import check_has_stats, check_names, check_sizes, dataset_cameras
from lerobot_wm.policies.common.config import PolicyConfig, train_new
from lerobot_wm.policies.common.features import Statistics, current_names

logger = logging.getLogger(__name__)

# Options of the Hub that `from_pretrained` passes on for each file.
_HUB_OPTIONS = ("revision", "token", "cache_dir", "force_download", "local_files_only")


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


class DivergenceError(RuntimeError):
    """A loss or a weight is NaN or infinite. The message is one line: what, and what to do."""


def check_finite(numbers: Mapping[str, float], config: object, batch: Mapping[str, Any]) -> None:
    """Stop a training whose loss is not finite.

    Every policy's `forward` calls it, so that `lerobot-train` stops as `lerobot-wm train` does.

    Args:
        numbers: The loss and its parts, by name.
        config: The policy's configuration, whose settings the message advises on.
        batch: The training batch; its episodes are named where it has `episode_index`.

    Raises:
        DivergenceError: A number is NaN or infinite.
    """
    broken = [name for name, value in numbers.items() if not math.isfinite(value)]
    if not broken:
        return
    where = ""
    if "episode_index" in batch:
        episodes = batch["episode_index"].unique().tolist()  # sorted
        where = f" on a batch of episodes {', '.join(map(str, episodes))}"
    raise DivergenceError(
        f"Training diverged: {', '.join(broken)} is NaN or infinite{where}. {_advice(config)}"
    )


def check_finite_weights(policy: nn.Module, config: object) -> None:
    """Keep weights that are not finite out of a checkpoint: a gradient can be so where the loss is not.

    Args:
        policy: What is to be saved.
        config: Its configuration, whose settings the message advises on.

    Raises:
        DivergenceError: A parameter or buffer is NaN or infinite.
    """
    broken = [name for name, tensor in policy.state_dict().items() if not torch.isfinite(tensor).all()]
    if broken:
        rest = f" and {len(broken) - 1} more" if len(broken) > 1 else ""
        raise DivergenceError(
            f"Training diverged: {broken[0]}{rest} holds NaN or infinite weights. {_advice(config)}"
        )


def _advice(config: object) -> str:
    rate = next(
        (f"--policy.{name}" for name in ("lr", "optimizer_lr") if hasattr(config, name)), "learning rate"
    )
    advice = f"Train again with a lower {rate}"
    if getattr(config, "dtype", None) == "bfloat16":
        advice += ", or in --policy.dtype=float32"
    return f"{advice}. Earlier checkpoints are not affected."

"""Strict loading of checkpoints."""

from copy import copy, deepcopy
from pathlib import Path
from typing import Any, NoReturn, Self

import torch
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from safetensors import SafetensorError

from lerobot_wm.hub.model_card import TrainingData, model_card
from lerobot_wm.policies.common.checkpoint import WHOLE, not_finite, read_config
from lerobot_wm.policies.common.fine_tuning import (
    check_action_size,
    check_kept,
    check_networks,
    fit_to_dataset,
)
from lerobot_wm.policies.world_model.config import WorldModelConfig

# What `from_pretrained` is told of the Hub, for each file.
_HUB_OPTIONS = ("revision", "token", "cache_dir", "force_download", "local_files_only")


class StrictPolicy(PreTrainedPolicy):
    """A LeRobot policy whose checkpoints must match to the last key and hold finite numbers."""

    # LeRobot insists on both for every class; each policy type sets its own.
    config_class = PreTrainedConfig
    name = "wm"

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
        """Load a checkpoint from a folder or the Hub; strict unless told otherwise.

        What it was trained with stays: weights, and the statistics that scale actions and proprioception. These are no
        dataset's own once training goes on with another, but the weights were fitted to them.

        Args:
            pretrained_name_or_path: Folder or Hub id.
            config: Its configuration, with changes; None takes the checkpoint's.
            dataset_meta: The dataset to train it on; None to act.
            strict: Whether weights must match to the last key.
            **kwargs: LeRobot's, such as `revision`.

        Raises:
            FileNotFoundError: The configuration or the weights are missing.
            ValueError: The checkpoint is of another type, its configuration is not one of this release, `config` makes
                other networks, keys are missing, left over or of another shape, weights are not finite, or the sizes
                of the dataset or environment are not the checkpoint's.
        """
        hub = {name: kwargs[name] for name in _HUB_OPTIONS if name in kwargs}
        saved = read_config(pretrained_name_or_path, **hub)
        if not isinstance(saved, cls.config_class):
            raise ValueError(
                f"{pretrained_name_or_path} is a {saved.type}, no {cls.name}: give a checkpoint of {cls.name}, or load "
                f"it as what it is, --policy.type={saved.type}."
            )
        config = config or deepcopy(saved)
        kwargs.pop(
            "dataset_stats", None
        )  # the checkpoint's own hold; these may have other names (--rename_map)
        check_kept(config, saved)
        if strict:
            check_networks(cls, config, saved)
        if dataset_meta is None:
            check_action_size(config, saved)
        else:
            fit_to_dataset(config, saved, dataset_meta)
            kwargs["dataset_meta"] = dataset_meta
        return super().from_pretrained(pretrained_name_or_path, config=config, strict=strict, **kwargs)

    def _save_pretrained(self, save_directory: Path, *args: Any, **kwargs: Any) -> None:
        """LeRobot's, without the revision of the checkpoint it was trained on from.

        LeRobot would look for that revision in this one's repository when it loads it by name.
        """
        super()._save_pretrained(save_directory, *args, **kwargs)
        config = copy(self.config)
        config.pretrained_revision = None
        config._save_pretrained(save_directory)

    @classmethod
    def _load_as_safetensor(cls, model: Self, model_file: str, map_location: str, strict: bool) -> Self:
        if not Path(model_file).is_file():
            raise FileNotFoundError(f"{model_file} is missing, the weights of the checkpoint: {WHOLE}.")
        try:
            model = super()._load_as_safetensor(model, model_file, map_location, strict)
        except (RuntimeError, SafetensorError) as error:
            raise ValueError(
                f"{model_file} does not fit a {cls.name} of its config.json: {error}. The file was cut short or "
                "belongs to another configuration: copy the checkpoint folder again, whole."
            ) from error
        bad = [name for name, tensor in model.state_dict().items() if not torch.isfinite(tensor).all()]
        if bad:
            raise ValueError(f"{model_file} {not_finite(bad)}")
        return model

    def wrap_with_peft(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuse adapters (`--peft.*`): LeRobot loads their base with the settings of the trained policy.

        Raises:
            ValueError: Always; says what to do instead.
        """
        raise ValueError(
            f"--peft: {self.name} takes no adapters. Its networks are small: leave the --peft flags out, and all "
            "weights are trained on from --policy.path."
        )

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> ModelCard:
        """The card that LeRobot publishes with a policy it has trained; its last two arguments tell all."""
        data = None if dataset_meta is None else TrainingData.of(dataset_meta)
        repo_id = self.config.repo_id or model_type
        makes_latents = isinstance(self.config, WorldModelConfig)
        return model_card(
            type(self),
            self.config,
            repo_id,
            cfg,
            data,
            features_read=self.config.features_read,
            makes_latents=makes_latents,
        )

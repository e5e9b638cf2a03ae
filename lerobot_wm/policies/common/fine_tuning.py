"""Training that goes on from a checkpoint, on the same dataset or another one."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from copy import deepcopy
from dataclasses import fields, is_dataclass
from functools import reduce
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_wm.constants import ACTION
from lerobot_wm.policies.common.cameras import ImagePolicyConfig
from lerobot_wm.policies.common.features import OWN_NAMES, image_keys, renamed
from lerobot_wm.policies.common.iql_config import IQLConfig
from lerobot_wm.policies.latent.config import LatentPolicyConfig

# Of every policy: what it reads, where it runs, where it is published.
_OF_ALL_TYPES = {item.name for item in fields(PreTrainedConfig)}


def check_networks(
    policy_class: type[PreTrainedPolicy], config: PreTrainedConfig, saved: PreTrainedConfig
) -> None:
    """Refuse settings that make other networks than a checkpoint has weights for; all others may be changed.

    Which they are is tried: a policy is made with each changed setting.

    Args:
        policy_class: The checkpoint's.
        config: The configuration to act or train with.
        saved: As it is in the checkpoint.

    Raises:
        ValueError: A setting makes parameters more, fewer or of other shapes; names it and both values.
    """
    known, given = _settings(saved), _settings(config)
    changed = [name for name in known.keys() & given.keys() if given[name] != known[name]]
    if not changed:
        return
    shapes = _shapes(policy_class, saved)
    others = [
        f"--policy.{name}={_text(given[name])} (the checkpoint's is {_text(known[name])})"
        for name in sorted(changed)
        if _shapes(policy_class, _with(saved, name, given[name])) != shapes
    ]
    if others:
        raise ValueError(
            f"{', '.join(others)}: other networks than the checkpoint has weights for. Leave the flag out, or train a "
            f"new {saved.type}, --policy.type={saved.type} in place of --policy.path."
        )


def _settings(config: Any, prefix: str = "") -> dict[str, Any]:
    """The settings of a policy type's own, under their flags' dotted names."""
    settings: dict[str, Any] = {}
    for name in (item.name for item in fields(config) if item.name not in _OF_ALL_TYPES):
        value = getattr(config, name)
        settings |= _settings(value, f"{prefix}{name}.") if is_dataclass(value) else {prefix + name: value}
    return settings


def _with(saved: PreTrainedConfig, name: str, value: Any) -> PreTrainedConfig:
    """A configuration with one setting changed."""
    config = deepcopy(saved)
    *path, last = name.split(".")
    setattr(reduce(getattr, path, config), last, value)
    return config


def _shapes(policy_class: type[PreTrainedPolicy], config: PreTrainedConfig) -> dict[str, torch.Size]:
    """Of every parameter and buffer that a policy of this configuration saves."""
    with torch.random.fork_rng(devices=[]):  # a seeded training draws the same numbers after this
        policy = policy_class(deepcopy(config))
    return {name: tensor.shape for name, tensor in policy.state_dict().items()}


def _text(value: Any) -> str:
    """As on a command line."""
    return str(value).lower() if isinstance(value, bool) else str(value)


_RENAME_MAP: ContextVar[Mapping[str, str]] = ContextVar("rename_map", default=OWN_NAMES)


@contextmanager
def names_given_by(rename_map: Mapping[str, str]) -> Iterator[None]:
    """Have policies that are made here know `--rename_map`, of which LeRobot tells its processors alone."""
    token = _RENAME_MAP.set(rename_map)
    try:
        yield
    finally:
        _RENAME_MAP.reset(token)


def fit_to_dataset(
    config: ImagePolicyConfig, saved: ImagePolicyConfig, dataset_meta: LeRobotDatasetMetadata
) -> None:
    """Check that a checkpoint can be trained on a dataset, and have it expect the dataset's cameras.

    Actions and numbers that the policy reads need the checkpoint's sizes. Images are resized to what its networks take,
    so that cameras may have another size than before: the policy is then for cameras of this size.

    Args:
        config: The configuration to train with; changed in place. LeRobot has given it the dataset's actions.
        saved: As it is in the checkpoint.
        dataset_meta: The dataset to train on, with new names of its features inside `names_given_by`. Cameras of one
            size need none.

    Raises:
        ValueError: A size differs; names both.
    """
    rename_map = _RENAME_MAP.get()
    check_sizes(
        saved,
        (*saved.features_read, ACTION),
        dataset_meta,
        rename_map,
        f"train it on with data of the same robot, or train anew with --policy.type={saved.type} in place of "
        "--policy.path",
    )
    features = dataset_to_policy_features(dataset_meta.features)
    shapes = {features[key].shape for key in image_keys(features)}  # none of a latent dataset
    if len(shapes) == 1:
        config.input_features |= {key: PolicyFeature(FeatureType.VISUAL, *shapes) for key in saved.cameras}
    known = renamed(features, rename_map)
    config.input_features |= {key: known[key] for key in saved.cameras if key in known}


def check_sizes(
    saved: ImagePolicyConfig,
    keys: Iterable[str],
    dataset_meta: LeRobotDatasetMetadata,
    rename_map: Mapping[str, str],
    mend: str,
) -> None:
    """Refuse a dataset whose numbers are of other sizes than those a checkpoint was trained with.

    A feature that the dataset lacks is passed over, and so are images.

    Args:
        saved: The checkpoint's configuration.
        keys: Of the features to compare.
        dataset_meta: The dataset's.
        rename_map: New names of its features, where they are known.
        mend: What to do, for the message.

    Raises:
        ValueError: A size differs; names both.
    """
    features = renamed(dataset_to_policy_features(dataset_meta.features), rename_map)
    for key in filter(features.__contains__, keys):
        known = (saved.output_features if key == ACTION else saved.input_features)[key]
        found = features[key]
        if known.type is not FeatureType.VISUAL and known.shape != found.shape:
            raise ValueError(
                f"This {saved.type} was trained with '{key}' of size {known.shape[0]}, {dataset_meta.repo_id} has it "
                f"with {found.shape[0]}: {mend}."
            )


def check_kept(config: PreTrainedConfig, saved: PreTrainedConfig) -> None:
    """Refuse to change what a checkpoint holds: its cameras, its world model, and the β of its actors.

    Args:
        config: The configuration to act or train with.
        saved: As it is in the checkpoint.

    Raises:
        ValueError: A setting names other cameras, another world model, or a β without an actor.
    """
    anew = f"train a new {saved.type}, --policy.type={saved.type} in place of --policy.path"
    both_on_latents = isinstance(saved, LatentPolicyConfig) and isinstance(config, LatentPolicyConfig)
    if both_on_latents and config.world_model_path != saved.world_model_path:
        raise ValueError(
            f"--policy.world_model_path={config.world_model_path}: the policy of --policy.path has its world model in "
            f"it, {saved.world_model_path}, and was fitted to it. Leave the flag out, or {anew}."
        )
    both_see = isinstance(saved, ImagePolicyConfig) and isinstance(config, ImagePolicyConfig)
    if both_see and [key.strip() for key in config.cameras] != saved.cameras:
        raise ValueError(
            f"--policy.image_key={config.image_key}: the {saved.type} of --policy.path was fitted to "
            f"{saved.image_key or 'no camera'}, in this order. Leave the flag out, give these names to other cameras "
            f"by --rename_map, or {anew}."
        )
    if isinstance(saved, IQLConfig) and isinstance(config, IQLConfig):
        untrained = [beta for beta in config.sweep_betas if beta not in saved.trained_betas]
        if untrained:
            raise ValueError(
                f"--policy.sweep_betas: no actor of the policy of --policy.path was trained with beta "
                f"{', '.join(f'{beta:g}' for beta in untrained)}; it has actors for "
                f"{', '.join(f'{beta:g}' for beta in saved.trained_betas)}. Leave the flag out, or {anew}."
            )


def check_action_size(config: PreTrainedConfig, saved: PreTrainedConfig) -> None:
    """Refuse an environment or robot with actions of another size than a checkpoint's.

    Args:
        config: The configuration to act with; LeRobot has given it the environment's actions.
        saved: As it is in the checkpoint.

    Raises:
        ValueError: The sizes differ.
    """
    known, found = saved.output_features.get(ACTION), config.output_features.get(ACTION)
    if known is not None and found is not None and tuple(known.shape) != tuple(found.shape):
        raise ValueError(
            f"This {saved.type} was trained with '{ACTION}' of size {known.shape[0]}, the robot or environment takes "
            f"{found.shape[0]}: use the kind that its dataset was recorded on."
        )

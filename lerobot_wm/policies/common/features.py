"""Cameras and vectors by name: their shapes, joined values, statistics, and names after `--rename_map`."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import MappingProxyType
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.feature_utils import dataset_to_policy_features
from torch import Tensor

from lerobot_wm.constants import OBS_IMAGE
from lerobot_wm.nn.images import channels_first

Statistics = Mapping[str, Mapping[str, Any]]
OWN_NAMES: Mapping[str, str] = MappingProxyType({})  # the rename_map that changes no name


def feature_dim(features: dict[str, PolicyFeature], key: str) -> int:
    """Size of the vector feature `key`.

    Raises:
        ValueError: The feature is missing, or is no vector.
    """
    if key not in features:
        raise ValueError(f"The dataset has no '{key}'; it has {sorted(features)}.")
    shape = tuple(features[key].shape)
    if len(shape) != 1:
        raise ValueError(f"'{key}' has the shape {shape}; expected a vector (N,).")
    return shape[0]


def policy_features(dataset_meta: LeRobotDatasetMetadata) -> dict[str, PolicyFeature]:
    """LeRobot's description of a dataset's features, with the channels of all cameras first."""
    features = dataset_to_policy_features(dataset_meta.features)
    cameras = {
        key: PolicyFeature(FeatureType.VISUAL, channels_first(features[key].shape))
        for key in image_keys(features)
    }
    return features | cameras


def image_keys(features: dict[str, PolicyFeature]) -> list[str]:
    """The camera keys among the features, in order."""
    return [key for key, feature in features.items() if feature.type is FeatureType.VISUAL]


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


def renamed(features: Mapping[str, PolicyFeature], rename_map: Mapping[str, str]) -> dict[str, PolicyFeature]:
    """The features of a dataset or environment under the names that `--rename_map` gives them.

    Raises:
        ValueError: Two get the same name; which one is read would depend on their order.
    """
    names = {old: rename_map.get(old, old) for old in features}
    for old, new in names.items():
        others = [key for key, name in names.items() if name == new and key != old]
        if others:
            raise ValueError(
                f"--rename_map: '{old}' and '{others[0]}' would both be named '{new}'. Give the one that is not to be "
                "read another name too."
            )
    return {names[old]: feature for old, feature in features.items()}


def names_before(keys: Iterable[str], rename_map: Mapping[str, str]) -> list[str]:
    """The names that features have in the dataset itself, before `--rename_map` gives them these `keys`."""
    before = {new: old for old, new in rename_map.items()}
    return [before.get(key, key) for key in keys]


_RENAME_MAP: ContextVar[Mapping[str, str]] = ContextVar("rename_map", default=OWN_NAMES)


@contextmanager
def names_given_by(rename_map: Mapping[str, str]) -> Iterator[None]:
    """Let policies that are loaded here know `--rename_map`, which LeRobot gives to its processors only."""
    token = _RENAME_MAP.set(rename_map)
    try:
        yield
    finally:
        _RENAME_MAP.reset(token)


def current_names() -> Mapping[str, str]:
    """The rename_map of the surrounding `names_given_by`."""
    return _RENAME_MAP.get()


def recorded_name(key: str) -> str:
    """The name that a feature of the surrounding `names_given_by` has in the dataset itself."""
    [name] = names_before([key], current_names())
    return name

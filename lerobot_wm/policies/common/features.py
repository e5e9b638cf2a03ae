"""What the policy configurations share: precision, and reading names and sizes from LeRobot's features."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.utils import STATS_PATH
from torch import Tensor

from lerobot_wm.constants import OBS_IMAGE

# Scaling is part of our models (lerobot_wm.nn.normalize): a policy and the frozen world model inside it were
# fitted on different statistics, which one processor pipeline cannot hold. LeRobot's normalisers do nothing.
IDENTITY_NORMALIZATION: dict[str, NormalizationMode] = dict.fromkeys(
    ("VISUAL", "STATE", "ENV", "ACTION"), NormalizationMode.IDENTITY
)

OWN_NAMES: Mapping[str, str] = MappingProxyType({})  # the rename_map of a dataset whose names hold


def default_dtype(device: str) -> str:
    """The autocast type training runs fastest in: bfloat16 where the hardware multiplies it, else float32."""
    if device.startswith("cuda"):
        return "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float32"
    return "bfloat16" if device == "cpu" and torch.cpu._is_avx512_bf16_supported() else "float32"


def training_dtype(dtype: str | None, device: str) -> str:
    """The autocast type of training: `dtype`, or the device's default where it is None.

    Raises:
        ValueError: It is not known; LeRobot and accelerate would take it for float32.
    """
    if dtype not in (None, "bfloat16", "float32"):
        raise ValueError(f"dtype is '{dtype}'; expected 'bfloat16' or 'float32'.")
    return dtype or default_dtype(device)


def check_has_stats(dataset_meta: LeRobotDatasetMetadata | None) -> None:
    """Refuse a dataset to train on without statistics, which scale actions and proprioception.

    LeRobot's loop goes on without them, and gives a policy that is made new none, as if it were a checkpoint's.

    Raises:
        ValueError: It has none; says how to have them computed.
    """
    if dataset_meta is not None and dataset_meta.stats is None:
        raise ValueError(
            f"{dataset_meta.repo_id} has no statistics ({dataset_meta.root}/{STATS_PATH}), which scale actions and "
            "proprioception: have them computed with lerobot-edit-dataset --operation.type=recompute_stats."
        )


def feature_dim(features: dict[str, PolicyFeature], key: str) -> int:
    """Size of the vector feature `key` of a dataset.

    Raises:
        ValueError: The feature is missing; names what is there. Or it is one number: LeRobot stores it without its
            axis, and the batch it makes of B of them, (1, B), cannot be told from one vector of B numbers.
    """
    if key not in features:
        raise ValueError(f"The dataset has no '{key}'; it has {sorted(features)}.")
    size = features[key].shape[0]
    if size == 1:
        raise ValueError(
            f"'{key}' has the shape (1,); expected two numbers or more, since LeRobot's batches lose the axis of a "
            "single one. Record it with a second number, which may be constant."
        )
    return size


def image_keys(features: dict[str, PolicyFeature]) -> list[str]:
    """The camera keys among the features, in order."""
    return [key for key, feature in features.items() if feature.type is FeatureType.VISUAL]


def renamed(features: Mapping[str, PolicyFeature], rename_map: Mapping[str, str]) -> dict[str, PolicyFeature]:
    """The features of a dataset or environment under the names that `--rename_map` gives them.

    Raises:
        ValueError: Two would have one name: which of them is read would depend on their order.
    """
    names = {old: rename_map.get(old, old) for old in features}
    for old, new in names.items():
        others = [key for key, name in names.items() if name == new and key != old]
        if others:
            raise ValueError(
                f"--rename_map: '{old}' and '{others[0]}' would both be '{new}'. Give the one that is not to be read "
                "another name as well."
            )
    return {names[old]: feature for old, feature in features.items()}


def names_before(keys: Iterable[str], rename_map: Mapping[str, str]) -> list[str]:
    """What the features of these names are called in the dataset itself, which `--rename_map` leaves as it is."""
    before = {new: old for old, new in rename_map.items()}
    return [before.get(key, key) for key in keys]


def stat(dataset_stats: dict[str, dict[str, Any]] | None, key: str, name: str) -> Tensor:
    """One statistic of a dataset feature as a float32 vector.

    Raises:
        ValueError: The dataset carries no such statistic.
    """
    if not dataset_stats or key not in dataset_stats or name not in dataset_stats[key]:
        if key.startswith(OBS_IMAGE):
            mend = "LeRobot can't make it anew for images: leave out --policy.rssm.standardize_images, or record again"
        else:
            mend = "lerobot-edit-dataset --operation.type=recompute_stats makes a copy of the dataset that has it"
        raise ValueError(
            f"The dataset's meta/stats.json has no '{name}' of '{key}', which scales the model's inputs: {mend}."
        )
    return torch.as_tensor(dataset_stats[key][name], dtype=torch.float32).flatten()


def logged(parts: dict[str, Tensor]) -> dict[str, float]:
    """Scalars by name as numbers, in one transfer from the device for all of them."""
    if not parts:
        return {}
    return dict(zip(parts, torch.stack(list(parts.values())).tolist(), strict=True))

"""The numeric columns of a LeRobotDataset as tensors, read from Arrow in one pass."""

import logging
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from datasets import Dataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import STATS_PATH
from torch import Tensor

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.data.check import RECOMPUTE, DatasetError, brief

logger = logging.getLogger(__name__)

TEXT_DTYPES = ("string", "language")


def column_tensor(dataset: Dataset, key: str, shape: tuple[int, ...]) -> Tensor:
    """All rows of a numeric column, with the type and shape that LeRobot's loader returns.

    Args:
        dataset: `LeRobotDataset.hf_dataset`.
        key: The column.
        shape: The feature's shape; a column of shape (1,) is stored and returned without that axis.

    Returns:
        (N, *shape): float32 for any float, int64 for any integer, bool for booleans.
    """
    column = dataset.data.table.column(key)
    if dataset._indices is not None:
        column = column.take(dataset._indices.column(0))
    # Arrow memory-maps the table: a float32 or int64 column is copied only here, when its chunks are joined.
    values = np.concatenate([_flat_values(chunk) for chunk in column.chunks])  # (N * prod(shape),)
    if values.dtype != bool:
        values = values.astype(
            np.int64 if np.issubdtype(values.dtype, np.integer) else np.float32, copy=False
        )
    tensor = torch.from_numpy(values)
    return tensor if shape == (1,) else tensor.reshape(-1, *shape)


def frame_values(meta: LeRobotDatasetMetadata, key: str) -> Tensor:
    """Read a numeric column from a dataset's files.

    Args:
        meta: The dataset's metadata; its tables are on this machine.
        key: The column.

    Returns:
        (N, *shape) float32 by absolute frame index, (N,) for a column of shape (1,); zero for episodes that were not
        downloaded.

    Raises:
        FileNotFoundError: No table is on this machine.
    """
    shape = tuple(meta.features[key]["shape"])
    numbers = torch.zeros(meta.total_frames, *(() if shape == (1,) else shape))
    index, values = _read_columns(meta, key)
    numbers[torch.from_numpy(index)] = torch.from_numpy(values.astype(np.float32)).view(
        -1, *numbers.shape[1:]
    )
    return numbers


def frames_on_disk(meta: LeRobotDatasetMetadata, *keys: str) -> list[Tensor]:
    """Read numeric columns of the frames that are on this machine, in their order.

    Returns:
        (N, size) float32 of each column.

    Raises:
        FileNotFoundError: No table is on this machine.
    """
    index, *columns = _read_columns(meta, *keys)
    return [torch.from_numpy(values.astype(np.float32)).view(len(index), -1) for values in columns]


def episode_values(meta: LeRobotDatasetMetadata, *keys: str) -> list[list[int]]:
    """The different values of integer columns in each episode.

    Returns:
        [episode, value of each column] once each, in order; none where a column is missing, or no table is on this
        machine.
    """
    if not _tables(meta) or not set(keys) <= set(meta.features):
        return []
    columns = [values.astype(int) for values in _read_columns(meta, "episode_index", *keys)[1:]]
    return np.unique(np.stack(columns, axis=1), axis=0).tolist()


def _read_columns(meta: LeRobotDatasetMetadata, *keys: str) -> list[np.ndarray]:
    """The index (N,) of the frames on this machine, and the numbers (N * size,) in each column; reads a table once."""
    names = ("index", *keys)
    tables = [pq.read_table(path, columns=list(names)) for path in _tables(meta)]
    if not tables:
        raise FileNotFoundError(
            f"{Path(meta.root) / 'data'} has no tables to read {', '.join(keys)} from: train without "
            f"--dataset.streaming=true, or download {meta.repo_id} to that folder first."
        )
    return [
        np.concatenate([_flat_values(chunk) for table in tables for chunk in table[name].chunks])
        for name in names
    ]


def _tables(meta: LeRobotDatasetMetadata) -> list[Path]:
    return sorted((Path(meta.root) / "data").rglob("*.parquet"))


# Change from frame to frame over the actions' standard deviation, median over their numbers. It is 0.03 to 0.1 for
# joint targets at 10 to 50 Hz, and 0.5 to 0.7 for Meta-World's velocities.
_SMALL_CHANGE = 0.25


def last_action_predicts_next(meta: LeRobotDatasetMetadata) -> bool:
    """Whether actions hardly change from one frame to the next, so that copying the last one is nearly right.

    False for a dataset whose tables are not on this machine.
    """
    if not _tables(meta):
        return False
    action, episode = frames_on_disk(meta, ACTION, "episode_index")  # (N, A), (N, 1)
    same_episode = episode.flatten().diff() == 0  # (N - 1,)
    change, spread = action.diff(dim=0)[same_episode].std(0), action.std(0)  # (A,)
    moves = spread > 0
    return bool(moves.any()) and (change[moves] / spread[moves]).median().item() <= _SMALL_CHANGE


# An action's number counts as a target for a measured one where their difference varies this much less.
_RELATIVE_SPREAD = 0.5
_NO_DISTANCE = 1e-4


def relative_to_state(meta: LeRobotDatasetMetadata) -> list[int]:
    """The numbers of the action that are targets for the same number of the state, such as a joint's position.

    The state must have as many numbers as the action, and the difference of the two at most half the standard deviation
    of the action: this holds for joint targets, and not for velocities.

    Returns:
        Their indices; none for a dataset whose tables are not on this machine.
    """
    shapes = [tuple(meta.features.get(key, {"shape": ()})["shape"]) for key in (ACTION, OBS_STATE)]
    if shapes[0] != shapes[1] or not _tables(meta):
        return []
    action, state = frames_on_disk(meta, ACTION, OBS_STATE)  # (N, A) each
    spread, distance = action.std(0), (action - state).std(0)  # (A,)
    chosen = (spread > 0) & (distance <= _RELATIVE_SPREAD * spread)  # (A,)
    if chosen.any() and (distance[chosen] <= _NO_DISTANCE * spread[chosen]).all():
        logger.warning(
            "The actions of %s are the state of the same frame: a policy learns to stay where it is. Record what was "
            "commanded, or take each action from the next frame's state.",
            meta.repo_id,
        )
    return chosen.nonzero().flatten().tolist()


def _flat_values(array: pa.Array) -> np.ndarray:
    """The numbers in one chunk of a column, without the lists they are stored in."""
    if isinstance(array, pa.ExtensionArray):
        array = array.storage
    while pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
        array = array.flatten()
    return array.to_numpy(zero_copy_only=False)


# Prefixes of the features that policies learn from.
_LEARNED = (ACTION, "observation.", "next.")


def check_finite_dataset(dataset: LeRobotDataset) -> None:
    """Check that all observations, actions and rewards of a dataset are finite.

    Raises:
        DatasetError: See `check_finite_columns`.
    """
    features = dataset.meta.features
    wanted = [
        key for key in features if key.startswith(_LEARNED) and features[key]["dtype"].startswith("float")
    ]
    columns = {
        key: column_tensor(dataset.hf_dataset, key, tuple(features[key]["shape"]))
        for key in (*wanted, "task_index", "episode_index", "frame_index")
    }
    check_finite_columns(columns, dataset.meta)


def check_finite_columns(columns: Mapping[str, Tensor], meta: LeRobotDatasetMetadata) -> None:
    """Check that observations, actions and rewards are finite.

    Args:
        columns: Tensors (N, ...), including `task_index`, `episode_index` and `frame_index` (N,).
        meta: The dataset's metadata.

    Raises:
        DatasetError: Names the column, task, episode and frame, and the command that removes what is not finite.
    """
    for key, values in columns.items():
        if not key.startswith(_LEARNED) or not values.is_floating_point():
            continue
        is_finite = values.isfinite().flatten(1).all(1) if values.ndim > 1 else values.isfinite()  # (N,)
        if is_finite.all():
            continue
        row = int(is_finite.int().argmin())
        task, episode, frame = (
            int(columns[name][row]) for name in ("task_index", "episode_index", "frame_index")
        )
        damaged = columns["episode_index"][~is_finite].int().unique().tolist()
        removal = f"--operation.type=delete_episodes --operation.episode_indices='{damaged}'"
        if len(damaged) == meta.total_episodes:
            if key == ACTION:
                raise DatasetError(
                    f"{meta.repo_id}: {key} is NaN or Inf in every episode; in episode {episode}, it is in frame "
                    f"{frame}. Leave out these frames where the data was recorded or converted, and make it again."
                )
            removal = f"--operation.type=remove_feature --operation.feature_names=\"['{key}']\""
        name = meta.repo_id.split("/")[-1]
        raise DatasetError(
            f"{meta.repo_id}: {key} is NaN or Inf in episode {episode} (task {str(meta.tasks.index[task])!r}), frame "
            f"{frame}. Train on a copy without it: `lerobot-edit-dataset --repo_id={meta.repo_id} --root={meta.root} "
            f"--new_repo_id={meta.repo_id}_finite --new_root=data/{name}_finite {removal}`."
        )


def check_stats(meta: LeRobotDatasetMetadata) -> None:
    """Check the statistics that scale actions and proprioception: LeRobot would train without them, on NaN too.

    Raises:
        DatasetError: They are missing or not finite; names the frame if a column is not finite itself.
    """
    for feature in (name for name in (ACTION, OBS_STATE) if name in meta.features):
        size = math.prod(meta.features[feature]["shape"])
        for name in ("min", "max", "mean", "std"):
            try:
                values = np.asarray(meta.stats[feature][name], dtype=np.float64)
            except (LookupError, TypeError, ValueError):  # missing, or no numbers
                values = np.empty(0)
            if values.size == size and np.isfinite(values).all():
                continue
            if _tables(meta):
                keys = (feature, "task_index", "episode_index", "frame_index")
                check_finite_columns({key: frame_values(meta, key) for key in keys}, meta)
            raise DatasetError(
                f"{meta.root / STATS_PATH}: {name} of {feature} is {brief(values.tolist())}; expected {size} finite "
                f"numbers, which scale it: {RECOMPUTE}."
            )

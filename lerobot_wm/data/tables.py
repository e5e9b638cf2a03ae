"""The numeric columns of a LeRobotDataset as tensors, read from Arrow in one pass."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from datasets import Dataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_wm.constants import ACTION
from lerobot_wm.data.source import DatasetError


def column_tensor(dataset: Dataset, key: str, shape: tuple[int, ...]) -> Tensor:
    """One numeric column as LeRobot's loader would return it, for all rows.

    Args:
        dataset: `LeRobotDataset.hf_dataset`.
        key: The column.
        shape: The feature's shape; (1,) is stored, and returned, without an axis.

    Returns:
        (N, *shape): float32 for any float, int64 for any integer, bool for booleans.
    """
    column = dataset.data.table.column(key)
    if dataset._indices is not None:
        column = column.take(dataset._indices.column(0))
    # Arrow maps the table from its file: joining the chunks is the one copy of a float32 or int64 column.
    values = np.concatenate([_flat_values(chunk) for chunk in column.chunks])  # (N * prod(shape),)
    if values.dtype != bool:
        values = values.astype(
            np.int64 if np.issubdtype(values.dtype, np.integer) else np.float32, copy=False
        )
    tensor = torch.from_numpy(values)
    return tensor if shape == (1,) else tensor.reshape(-1, *shape)


def frame_numbers(meta: LeRobotDatasetMetadata, key: str) -> Tensor:
    """A column of one number per frame, read from the dataset's files.

    Args:
        meta: The dataset's; its tables are on this machine.
        key: The column.

    Returns:
        (N,) float32 by absolute frame index; zero for episodes that were not downloaded.

    Raises:
        FileNotFoundError: None of its tables is here.
    """
    numbers = torch.zeros(meta.total_frames)
    paths = sorted((Path(meta.root) / "data").rglob("*.parquet"))
    if not paths:
        raise FileNotFoundError(
            f"{Path(meta.root) / 'data'} has no tables, and {key} is read from them: train without "
            f"--dataset.streaming=true, or download {meta.repo_id} to that folder first."
        )
    for path in paths:
        table = pq.read_table(path, columns=["index", key])
        index, values = (
            np.concatenate([_flat_values(chunk) for chunk in table[name].chunks]) for name in ("index", key)
        )
        numbers[torch.from_numpy(index)] = torch.from_numpy(values.astype(np.float32))
    return numbers


def _flat_values(array: pa.Array) -> np.ndarray:
    """The numbers of a column's chunk in order, without the lists they are stored in."""
    if isinstance(array, pa.ExtensionArray):
        array = array.storage
    while pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
        array = array.flatten()
    return array.to_numpy(zero_copy_only=False)


_READ = (ACTION, "observation.", "next.")  # beginnings of the names of all that is learned from


def check_finite_dataset(dataset: LeRobotDataset) -> None:
    """Refuse a dataset with a number that is not finite among its observations, actions and rewards.

    Raises:
        DatasetError: See `check_finite_columns`.
    """
    features = dataset.meta.features
    wanted = [key for key in features if key.startswith(_READ) and features[key]["dtype"].startswith("float")]
    columns = {
        key: column_tensor(dataset.hf_dataset, key, tuple(features[key]["shape"]))
        for key in (*wanted, "task_index", "episode_index", "frame_index")
    }
    check_finite_columns(columns, [str(task) for task in dataset.meta.tasks.index], dataset.repo_id)


def check_finite_columns(columns: Mapping[str, Tensor], tasks: Sequence[str], repo_id: str) -> None:
    """Refuse observations, actions and rewards with a number that is not finite.

    Args:
        columns: (N, ...) each, `task_index`, `episode_index` and `frame_index` (N,) among them.
        tasks: Task strings by task_index.
        repo_id: The dataset's name, for the message.

    Raises:
        DatasetError: Naming the column, the task, the episode and the frame.
    """
    for key, values in columns.items():
        if not key.startswith(_READ) or not values.is_floating_point():
            continue
        finite = values.isfinite().flatten(1).all(1) if values.ndim > 1 else values.isfinite()  # (N,)
        if finite.all():
            continue
        row = int(finite.int().argmin())
        task, episode, frame = (
            int(columns[name][row]) for name in ("task_index", "episode_index", "frame_index")
        )
        raise DatasetError(
            f"{repo_id}: {key} holds NaN or Inf in episode {episode} (task {tasks[task]!r}), frame {frame}: nothing "
            "can be learned from it. Remove the episode with lerobot-edit-dataset, or record it again; or remove the "
            "feature there, if no policy is to read it."
        )

"""The numeric columns of a LeRobotDataset as tensors, read from Arrow in one pass."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from datasets import Dataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor


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

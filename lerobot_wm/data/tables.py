"""The numeric columns of a LeRobotDataset as tensors, read from Arrow in one pass."""

import numpy as np
import pyarrow as pa
import torch
from datasets import Dataset
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
    array = dataset.data.table.column(key).combine_chunks()
    if dataset._indices is not None:
        array = array.take(dataset._indices.column(0).combine_chunks())
    if isinstance(array, pa.ExtensionArray):
        array = array.storage
    while pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
        array = array.flatten()
    values = array.to_numpy(zero_copy_only=False)
    if values.dtype == bool:
        tensor = torch.from_numpy(values.copy())
    elif np.issubdtype(values.dtype, np.integer):
        tensor = torch.from_numpy(values.astype(np.int64))
    else:
        tensor = torch.from_numpy(values.astype(np.float32))
    return tensor if shape == (1,) else tensor.reshape(-1, *shape)

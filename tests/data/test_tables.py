"""Columns as tensors: the types and shapes of LeRobot's loader, whatever pieces the table is stored in."""

import datasets
import numpy as np
import pytest
import torch
from datasets import Features, List, Value

from lerobot_wm.data.tables import column_tensor

FEATURES = Features(
    {"vector": List(Value("float64"), length=3), "count": Value("int16"), "flag": Value("bool")}
)


@pytest.fixture(scope="module")
def table() -> datasets.Dataset:
    """Six rows in two chunks."""
    return datasets.concatenate_datasets(
        [
            datasets.Dataset.from_dict(
                {
                    "vector": np.arange(9.0).reshape(3, 3) + part,
                    "count": [part, 2, 3],
                    "flag": [True, False, True],
                },
                features=FEATURES,
            )
            for part in (0, 100)
        ]
    )


def test_columns_are_read_across_chunks(table: datasets.Dataset) -> None:
    assert len(table.data.table.column("count").chunks) == 2
    vectors = column_tensor(table, "vector", (3,))
    assert vectors.dtype == torch.float32
    assert vectors.tolist() == [
        [0, 1, 2],
        [3, 4, 5],
        [6, 7, 8],
        [100, 101, 102],
        [103, 104, 105],
        [106, 107, 108],
    ]
    counts = column_tensor(table, "count", (1,))
    assert (counts.dtype, counts.tolist()) == (torch.int64, [0, 2, 3, 100, 2, 3])
    flags = column_tensor(table, "flag", (1,))
    assert (flags.dtype, flags.tolist()) == (torch.bool, [True, False, True] * 2)


def test_a_selection_of_rows_is_read_in_its_order(table: datasets.Dataset) -> None:
    chosen = table.select([4, 0, 3])
    assert column_tensor(chosen, "vector", (3,)).tolist() == [[103, 104, 105], [0, 1, 2], [100, 101, 102]]
    assert column_tensor(chosen, "count", (1,)).tolist() == [2, 0, 100]

"""Columns of numbers from a parquet file that may come from anywhere."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from lerobot_wm.data.check_info import MEND, read_file, shown
from lerobot_wm.data.errors import DatasetError

_MAX = 2**40  # frames or seconds: sums of these stay exact


def check_columns(path: Path, columns: Sequence[str]) -> None:
    """Refuse a file that lacks one of these columns, or has any column twice.

    Raises:
        DatasetError: It does, or cannot be read.
    """
    names = read_file(path, pq.read_schema).names
    for name in (*columns, *names):
        count = names.count(name)
        if count != 1:
            raise DatasetError(f"{path} has {count or 'no'} columns {shown(name)}; expected one: {MEND}.")


def read_whole(path: Path) -> None:
    """Read all of a file's columns, to know that they can be.

    Raises:
        DatasetError: One is damaged.
    """
    read_file(path, lambda path: sum(len(rows) for rows in pq.ParquetFile(path).iter_batches()))


def first_difference(
    table: pd.DataFrame, expected: Mapping[str, np.ndarray]
) -> tuple[str, int, object, object] | None:
    """Where a table is not as expected first: column, row, what is there and what should be; None where it is.

    Args:
        table: N rows.
        expected: Values (N,) by column, looked at in their order.
    """
    for name, values in expected.items():
        wrong = np.flatnonzero(table[name].to_numpy() != values)
        if len(wrong):
            row = int(wrong[0])
            return name, row, table[name][row], values[row]
    return None


def read_numbers(path: Path, whole: Sequence[str], real: Sequence[str]) -> pd.DataFrame:
    """Read columns of numbers that are 0 or more.

    Args:
        path: A parquet file.
        whole: Columns of integers, returned as int64.
        real: Columns of any numbers, returned as float64.

    Raises:
        DatasetError: A column is missing, or holds anything else.
    """
    check_columns(path, [*whole, *real])
    table = read_file(
        path, lambda path: pq.ParquetFile(path).read([*whole, *real]).to_pandas(ignore_metadata=True)
    )
    for name in table.columns:
        kind, kinds = ("whole numbers", "iu") if name in whole else ("numbers", "iuf")
        values = table[name]
        if values.dtype.kind not in kinds or not values.between(0, _MAX).all():
            raise DatasetError(
                f"{path}: {name} holds {shown(values.head(9).tolist())}; expected {kind}, 0 or more: {MEND}."
            )
    return table.astype({**dict.fromkeys(whole, np.int64), **dict.fromkeys(real, np.float64)})

"""The check of a dataset's tables of frames: every frame in its place, once."""

from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from lerobot_wm.data.check_info import MEND, Info, read_file
from lerobot_wm.data.check_tables import check_columns, first_difference, read_numbers, read_whole
from lerobot_wm.data.errors import DatasetError

_WHOLE = ("index", "episode_index", "frame_index", "task_index")


def check_frames(info: Info, episodes: pd.DataFrame, partial: bool) -> None:
    """Check the files under `data` against the table of episodes; only the columns that number frames are read.

    Args:
        info: The dataset's.
        episodes: Its episodes.
        partial: Files may be missing.

    Raises:
        DatasetError: A file is missing, broken, another one's or none of this dataset's, or frames are missing or there
            twice, or their times are of another frame rate.
    """
    tables = info.tables(episodes)
    foreign = sorted(set((info.root / "data").glob("*/*.parquet")) - tables.keys())
    if foreign:
        raise DatasetError(
            f"{foreign[0]} is none of the files that meta/episodes names: remove it, or {MEND}."
        )
    for path, rows in tables.items():
        if path.exists() or not partial:
            _check_table(info, path, rows)


def check_contents(root: Path) -> None:
    """Read the files under `data` whole, which `check_frames` leaves out.

    Raises:
        DatasetError: A file is damaged.
    """
    for path in sorted((root / "data").glob("*/*.parquet")):
        read_whole(path)


def _check_table(info: Info, path: Path, episodes: pd.DataFrame) -> None:
    check_columns(path, [name for name in info.features if name not in info.video_keys])
    rows = read_file(path, pq.read_metadata).num_rows
    lengths = episodes["length"].to_numpy()
    if rows != lengths.sum():
        raise DatasetError(
            f"{path} holds {rows} frames, its episodes in meta/episodes have {lengths.sum()}: {MEND}."
        )
    table = read_numbers(path, _WHOLE, ["timestamp"])
    frame = np.arange(rows) - np.repeat(np.cumsum(lengths) - lengths, lengths)  # within the episode
    expected = {
        "index": np.repeat(episodes["dataset_from_index"].to_numpy(), lengths) + frame,
        "episode_index": np.repeat(episodes["episode_index"].to_numpy(), lengths),
        "frame_index": frame,
        "task_index": table["task_index"].clip(upper=info.total_tasks - 1).to_numpy(),
    }
    difference = first_difference(table, expected)
    if difference is not None:
        name, row, found, wanted = difference
        raise DatasetError(
            f"{path}: {name} of row {row} is {found}; expected {wanted}: frames are there twice or "
            f"out of order, or the file is another one's; {MEND}."
        )
    if not (table["timestamp"] - frame / info.fps).abs().lt(0.5 / info.fps).all():
        raise DatasetError(
            f"{path}: its timestamps are not those of {info.fps:g} frames per second, as info.json says: set fps there "
            f"to what it was recorded at, or {MEND}."
        )

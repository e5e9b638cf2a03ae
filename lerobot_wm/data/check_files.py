"""Columns of numbers from a parquet file that may come from anywhere."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import load_episodes
from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR

from lerobot_wm.data.check_meta import MEND, Info, one_line, read_file, shown
from lerobot_wm.data.source import DatasetError

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


def check_tasks(info: Info) -> None:
    """Check `meta/tasks.parquet`: task i of the frames is the i-th of its rows.

    Raises:
        DatasetError: It is missing or broken, or its tasks are not numbered so.
    """
    path = info.root / DEFAULT_TASKS_PATH
    numbers, names = read_file(path, _read_tasks)
    if len(names) != info.total_tasks:
        raise DatasetError(f"{path} holds {len(names)} tasks, info.json says {info.total_tasks}: {MEND}.")
    if numbers != list(range(len(names))):
        raise DatasetError(f"{path}: task_index is {shown(numbers)}; expected 0, 1, 2 and so on: {MEND}.")
    if not all(isinstance(name, str) for name in names) or len(set(names)) != len(names):
        raise DatasetError(f"{path}: its tasks are {shown(names)}; expected strings, each once: {MEND}.")


def read_episodes(info: Info) -> pd.DataFrame:
    """Read and check `meta/episodes`.

    Returns:
        A row for each episode, in their order: its frames, its files and its place in them.

    Raises:
        DatasetError: A file is missing or broken, an episode is empty, or they do not follow each other.
    """
    folder = info.root / EPISODES_DIR
    paths = sorted(folder.glob("*/*.parquet"))
    if not paths:
        raise DatasetError(f"{folder} holds no table of the episodes: {MEND}.")
    whole = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
    whole += ["data/chunk_index", "data/file_index"]
    seconds = []
    for camera in info.video_keys:
        whole += [f"videos/{camera}/chunk_index", f"videos/{camera}/file_index"]
        seconds += [f"videos/{camera}/from_timestamp", f"videos/{camera}/to_timestamp"]
    for path in paths:
        check_columns(path, ["tasks"])
        read_whole(path)
    try:
        load_episodes(info.root)  # as LeRobot will
    except Exception as error:  # it raises whatever its libraries do
        raise DatasetError(
            f"{folder} cannot be read ({one_line(error.__cause__ or error)}): {MEND}."
        ) from error
    episodes = pd.concat([read_numbers(path, whole, seconds) for path in paths], ignore_index=True)
    if len(episodes) != info.total_episodes:
        raise DatasetError(
            f"{folder} holds {len(episodes)} episodes, info.json says {info.total_episodes}: {MEND}."
        )
    lengths = episodes["length"].to_numpy()
    stops = np.cumsum(lengths)
    expected = {
        "episode_index": np.arange(len(episodes)),
        "length": np.maximum(lengths, 1),  # no episode is empty
        "dataset_from_index": stops - lengths,
        "dataset_to_index": stops,
    }
    difference = first_difference(episodes, expected)
    if difference is not None:
        name, row, found, wanted = difference
        raise DatasetError(f"{folder}: {name} of episode {row} is {found}; expected {wanted}: {MEND}.")
    if stops[-1] != info.total_frames:
        raise DatasetError(
            f"{folder}: its episodes have {stops[-1]} frames, info.json says {info.total_frames}: {MEND}."
        )
    return episodes


def _read_tasks(path: Path) -> tuple[list[int], list[str]]:
    """Number and name of each task, as LeRobot reads them."""
    tasks = pd.read_parquet(path)
    return tasks["task_index"].astype(np.int64).tolist(), tasks.index.tolist()


_FPS_TOLERANCE = 0.01  # relative: headers round


def check_video_times(info: Info, camera: str, episodes: pd.DataFrame) -> None:
    """Check that each episode takes as long in a camera's video as its frames do, give or take one.

    Raises:
        DatasetError: The frame rate in info.json or the table of episodes is wrong.
    """
    first, last = (episodes[f"videos/{camera}/{name}_timestamp"].to_numpy() for name in ("from", "to"))
    frames = (last - first) * info.fps
    wrong = np.flatnonzero(~(np.abs(frames - episodes["length"].to_numpy()) < 1.5))
    if len(wrong):
        row = wrong[0]
        raise DatasetError(
            f"{info.root / EPISODES_DIR}: episode {row} has {episodes['length'][row]} frames and takes "
            f"{last[row] - first[row]:.2f} s of {camera}'s video, {frames[row]:.1f} frames at the {info.fps:g} per "
            f"second of info.json: set fps there to what it was recorded at, or {MEND}."
        )


def check_video_file(info: Info, camera: str, path: Path, seconds: float) -> None:
    """Check a video: is it whole, of this camera's size and rate, and long enough for its episodes?

    Args:
        info: The dataset's.
        camera: The feature.
        path: The file.
        seconds: Where its last episode ends.

    Raises:
        DatasetError: It is not.
    """
    missing = read_file(path, _bytes_missing)
    if missing:
        raise DatasetError(f"{path} lacks its last {missing} bytes: it was cut short; {MEND}.")
    frames, rate, size = read_file(path, _header)
    feature = info.features[camera]
    shape = dict(zip(feature["names"], feature["shape"], strict=True))
    expected = shape.get("width", size[0]), shape.get("height", size[1])
    if size != expected:
        raise DatasetError(
            f"{path} has images of {size[0]}x{size[1]}, info.json says {expected[0]}x{expected[1]}: it is another "
            f"camera's or dataset's; {MEND}."
        )
    if abs(rate - info.fps) > _FPS_TOLERANCE * info.fps:
        raise DatasetError(
            f"{path} has {rate:g} frames per second, info.json says {info.fps:g}: it is another dataset's, or fps is "
            f"wrong; {MEND}."
        )
    needed = round(seconds * info.fps)
    if frames < needed:
        raise DatasetError(
            f"{path} has {frames} frames, its episodes take {needed}: it is another one's, or was cut short; {MEND}."
        )


def _header(path: Path) -> tuple[int, float, tuple[int, int]]:
    """Number of frames, frames per second, (width, height)."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        if stream.average_rate is None:
            raise ValueError("it names no frame rate")
        header = stream.frames, float(stream.average_rate), (stream.width, stream.height)
    return header


def _bytes_missing(path: Path) -> int:
    """How many bytes an MP4 file's last box promises beyond the end of the file; 0 for other formats.

    FFmpeg opens a file that was cut short behind its header, and the frames are missed only in decoding.
    """
    size = path.stat().st_size
    position = 0
    with path.open("rb") as file:
        while position < size:
            file.seek(position)
            header = file.read(16)
            length = int.from_bytes(header[:4])
            if position == 0 and header[4:8] != b"ftyp":
                return 0
            if length == 1:  # a box of more than 4 GB: its length follows
                length = int.from_bytes(header[8:16])
            if length == 0:  # to the end of the file
                return 0
            if length < 8:
                raise ValueError("a box of less than its own header")
            position += length
    return position - size

"""Is a dataset on this machine complete and readable? Checked before any work.

LeRobot asks the Hub for missing files, and notices damaged ones late. The metadata, the columns that number the frames
and the headers of videos are read here; no image is decoded.
"""

import json
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.io_utils import load_episodes, load_info, load_stats, load_tasks
from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH, STATS_PATH
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_wm.errors import disk_problem

FIX = "copy or download the dataset again"
RECOMPUTE = (
    f"{FIX}, or train on a copy that `lerobot-edit-dataset --operation.type=recompute_stats` makes, with "
    "--dataset.use_imagenet_stats=false if it has no statistics of images"
)
# Each part of the metadata, and how LeRobot reads it.
_METADATA: dict[str, Callable[[Path], object]] = {
    INFO_PATH: load_info,
    STATS_PATH: load_stats,
    DEFAULT_TASKS_PATH: load_tasks,
    EPISODES_DIR: load_episodes,
}


class DatasetError(ValueError):
    """A dataset cannot be used; the message names the file, what is wrong with it and how to fix it."""


def read_file[T](path: Path, read: Callable[[Path], T]) -> T:
    """Read a file that may be missing or damaged.

    Raises:
        DatasetError: The file is missing, or the reader fails.
    """
    if not path.exists():
        raise DatasetError(
            f"{path} is missing: {FIX}. If its recording was interrupted before `finalize()`, record it again."
        )
    try:
        return read(path)
    except Exception as error:  # readers do not document what they raise for damaged files
        if disk_problem(error) is not None:  # such as a cache that cannot be written
            raise
        raise DatasetError(
            f"{path} cannot be read ({brief(error.__cause__ or error)}): it is incomplete or damaged; {FIX}."
        ) from error


def brief(error: object) -> str:
    """The beginning of a library's message, on one line and without control characters."""
    text = "".join(letter if letter.isprintable() else " " for letter in str(error))
    return " ".join(text.split())[:160]


def how_to_repair(repo_id: str, root: Path) -> str:
    """Advice for the end of a message: the command that writes a repaired copy."""
    return (
        f"train on the repaired copy that `lerobot-wm repair --dataset.repo_id={repo_id} --dataset.root={root} "
        f"--output_root=data/{repo_id.split('/')[-1]}_repaired` writes"
    )


def check_metadata_files(folder: Path, repo_id: str) -> None:
    """Check that the metadata is there, and of a version that LeRobot reads.

    Raises:
        DatasetError: A file is missing or damaged, or the dataset has another version.
    """
    path = folder / INFO_PATH
    info = read_file(path, lambda path: json.loads(path.read_text(encoding="utf-8")))
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not str(version).startswith("v3."):
        is_convertible = version in ("v2.0", "v2.1")
        fix = how_to_repair(repo_id, folder) if is_convertible else "record it with LeRobot 0.4 or later"
        raise DatasetError(f"{path}: codebase_version is {str(version)[:80]!r}; expected v3.0: {fix}.")
    if not (folder / STATS_PATH).is_file():
        raise DatasetError(
            f"{folder / STATS_PATH} is missing, which scales actions and proprioception: {RECOMPUTE}."
        )
    for name in _METADATA:
        read_file(folder / name, lambda path: None)
    if not list((folder / EPISODES_DIR).glob("*/*.parquet")):
        raise DatasetError(f"{folder / EPISODES_DIR} has no tables of episodes: {FIX}, or record it again.")


def name_damaged_metadata(folder: Path) -> None:
    """Find the file that LeRobot could not read.

    Raises:
        DatasetError: Names the file.
    """
    for name, load in _METADATA.items():

        def read(path: Path, load: Callable[[Path], object] = load) -> object:
            return load(folder)

        read_file(folder / name, read)


def name_damaged_table(folder: Path) -> None:
    """Read all tables of frames, of which `check_dataset` reads only some columns.

    Raises:
        DatasetError: Names the first file that cannot be read.
    """
    for path in sorted((folder / "data").glob("*/*.parquet")):
        read_file(path, lambda path: sum(len(rows) for rows in pq.ParquetFile(path).iter_batches()))


@contextmanager
def strange_entries_named(root: Path) -> Iterator[None]:
    """Turn errors that entries of the metadata cause while a dataset is checked into one that names the folder.

    LeRobot takes them without a look: a shape that is no list, for example.

    Raises:
        DatasetError: As a check raised it, or in place of another error.
    """
    try:
        yield
    except DatasetError:
        raise
    except Exception as error:
        raise DatasetError(
            f"{root / 'meta'} has entries that LeRobot does not write ({type(error).__name__}: {brief(error)}): "
            f"compare {INFO_PATH} with that of another dataset, or {FIX}."
        ) from error


def check_dataset(
    meta: LeRobotDatasetMetadata, *, partial: bool, chosen: Collection[int] | None = None
) -> None:
    """Check that a dataset's files are whole and belong together.

    Args:
        meta: Its metadata.
        partial: Whether files may be missing, because LeRobot downloads them when they are needed.
        chosen: The episodes that will be read; None for all. Files of other episodes may be missing.

    Raises:
        DatasetError: Names the file, what is wrong with it and how to fix it.
    """
    _check_names(meta)
    _check_numbering(meta, meta.features, meta.root / INFO_PATH)
    episodes = _read_episodes(meta)
    episodes["is_read"] = True if chosen is None else episodes["episode_index"].isin(chosen)
    _check_tables(meta, episodes, partial)
    for camera in meta.video_keys:
        _check_videos(meta, camera, episodes, partial)


def _check_names(meta: LeRobotDatasetMetadata) -> None:
    # Names of cameras become names of files in the cache.
    if bad := [name for name in meta.features if "/" in name]:
        raise DatasetError(
            f"{meta.root / INFO_PATH}: feature {bad[0]!r} has a slash in its name, which LeRobot takes "
            "for a folder: record or convert the data with another name."
        )
    path = meta.root / DEFAULT_TASKS_PATH
    numbers = read_file(path, lambda _: list(meta.tasks["task_index"]))
    # Task strings are looked up by their row.
    if numbers != list(range(len(numbers))):
        raise DatasetError(f"{path}: task_index is {str(numbers)[:80]}; expected 0, 1, 2 and so on: {FIX}.")


def _read_episodes(meta: LeRobotDatasetMetadata) -> pd.DataFrame:
    """The place of each episode in the dataset and its files, checked to follow each other."""
    folder = meta.root / EPISODES_DIR
    columns = ["episode_index", "length", "dataset_from_index", "data/chunk_index", "data/file_index"]
    for camera in meta.video_keys:
        columns += [f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "to_timestamp")]
    episodes = read_file(folder, lambda _: meta.episodes.select_columns(columns).to_pandas().astype(float))
    stops = episodes["length"].cumsum()
    wrong = (
        (episodes["episode_index"] != np.arange(len(episodes)))
        | ~(episodes["length"] >= 1)
        | (episodes["dataset_from_index"] != stops - episodes["length"])
    )
    if wrong.any():
        raise DatasetError(
            f"{folder}: episode {wrong.argmax()} is empty, or does not follow the one before it: {FIX}."
        )
    found, expected = (len(episodes), int(stops.iloc[-1])), (meta.total_episodes, meta.total_frames)
    if found != expected:
        raise DatasetError(
            f"{folder} has {found[0]} episodes with {found[1]} frames, {INFO_PATH} says {expected[0]} episodes with "
            f"{expected[1]} frames: {FIX}. If its recording was interrupted before `finalize()`, record it again."
        )
    return episodes


def _files_read(
    rows: pd.DataFrame, prefix: str, path_of: Callable[[int], Path], partial: bool
) -> dict[Path, pd.DataFrame]:
    """The files that will be read, with the episodes in each."""
    groups = [group for _, group in rows.groupby([f"{prefix}/chunk_index", f"{prefix}/file_index"])]
    files = {path_of(int(group["episode_index"].iloc[0])): group for group in groups}
    return {
        path: group
        for path, group in files.items()
        if group["is_read"].any() and (path.exists() or not partial)
    }


def _check_tables(meta: LeRobotDatasetMetadata, episodes: pd.DataFrame, partial: bool) -> None:
    paths = {meta.root / meta.get_data_file_path(episode) for episode in range(len(episodes))}
    unknown = sorted(set((meta.root / "data").glob("*/*.parquet")) - paths)
    if unknown:
        raise DatasetError(
            f"{unknown[0]} belongs to no episode, but LeRobot would read it: remove the file, or {FIX}."
        )
    columns = ["index", "episode_index", "frame_index", "timestamp"]
    files = _files_read(
        episodes, "data", lambda episode: meta.root / meta.get_data_file_path(episode), partial
    )
    for path, rows in files.items():
        _check_numbering(meta, read_file(path, lambda path: pq.read_schema(path).names), path)
        table = read_file(path, lambda path: pq.read_table(path, columns=columns).to_pandas().astype(float))
        lengths = rows["length"].astype(int)
        if len(table) != lengths.sum():
            raise DatasetError(
                f"{path} has {len(table)} frames; its episodes in {EPISODES_DIR} have {lengths.sum()}: {FIX}."
            )
        frame = np.concatenate([np.arange(length) for length in lengths])
        first = np.repeat(rows["dataset_from_index"].to_numpy(), lengths)
        episode = np.repeat(rows["episode_index"].to_numpy(), lengths)
        if (table["episode_index"] != episode).any() or (table["frame_index"].diff()[frame > 0] != 1).any():
            raise DatasetError(
                f"{path}: frames are repeated, missing or out of order, or belong to other episodes: {FIX}."
            )
        if (table["index"] != first + frame).any():
            raise DatasetError(
                f"{path}: index does not count the dataset's frames: {how_to_repair(meta.repo_id, meta.root)}."
            )
        if not (abs(table["timestamp"] * meta.fps - frame) < 0.5).all():
            step = float(table["timestamp"].diff()[frame > 0].median())
            raise DatasetError(
                f"{path}: the timestamps are not those of {meta.fps:g} frames per second, which is fps in {INFO_PATH}; "
                f"the median step is {step:.4f} s, {1 / step if step > 0 else 0:.1f} per second. If fps is wrong, "
                f"correct it there. If they are the times of a clock, {how_to_repair(meta.repo_id, meta.root)}."
            )


def _check_numbering(meta: LeRobotDatasetMetadata, names: Collection[str], path: Path) -> None:
    if missing := [name for name in DEFAULT_FEATURES if name not in names]:
        raise DatasetError(
            f"{path} lacks {', '.join(missing)}, by which LeRobot finds frames: "
            f"{how_to_repair(meta.repo_id, meta.root)}."
        )


def _check_videos(meta: LeRobotDatasetMetadata, camera: str, episodes: pd.DataFrame, partial: bool) -> None:
    prefix = f"videos/{camera}"

    def path_of(episode: int) -> Path:
        return meta.root / meta.get_video_file_path(episode, camera)

    for path, rows in _files_read(episodes, prefix, path_of, partial).items():
        if missing := read_file(path, _missing_bytes):
            raise DatasetError(f"{path} lacks its last {missing} bytes: it is incomplete; {FIX}.")
        frames = read_file(path, _video_frames)
        needed = round(rows[f"{prefix}/to_timestamp"].max() * meta.fps)
        if frames < needed:
            raise DatasetError(f"{path} has {frames} frames; its episodes need {needed}: {FIX}.")


def _video_frames(path: Path) -> int:
    """Number of frames, as the file's header states it."""
    with av.open(str(path)) as container:
        frames = container.streams.video[0].frames
    return frames


def _missing_bytes(path: Path) -> int:
    """How many bytes the last box of an MP4 file has beyond the end of the file; 0 for other formats.

    FFmpeg opens an incomplete file if its header is there, and notices only when it decodes the missing frames.
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
                raise ValueError("a box is shorter than its header")
            position += length
    return position - size

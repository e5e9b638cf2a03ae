"""Merging many small LeRobotDatasets into one, with each file written once.

LeRobot's own `aggregate_datasets` rewrites the growing video and tables for every dataset that it adds, so that its
time grows with the square of their number. The result here is the same: equal bytes of tables that fit into one file,
and equal packets of video. Larger outputs may be split into files one dataset earlier or later.
"""

from collections.abc import Callable, Iterable, Iterator
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import pandas as pd
from lerobot.datasets.aggregate import merge_video_feature_info_for_aggregate, update_meta_data
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.io_utils import (
    get_file_size_in_mb,
    get_parquet_file_size_in_mb,
    load_stats,
    load_tasks,
    to_parquet_one_row_group_per_episode,
    write_info,
    write_stats,
    write_tasks,
)
from lerobot.datasets.utils import (
    DATA_DIR,
    DEFAULT_DATA_PATH,
    DEFAULT_EPISODES_PATH,
    DEFAULT_VIDEO_PATH,
    EPISODES_DIR,
    update_chunk_file_indices,
)
from lerobot.datasets.video_utils import concatenate_video_files, get_video_duration_in_s

# (chunk index, file index) of a file.
type Place = tuple[int, int]


def merge_datasets(sources: list[Path], repo_id: str, root: Path) -> None:
    """Merge datasets of the same features, frame rate and codec, in their order, into one.

    Args:
        sources: Their folders; each dataset is complete, and fits into one data file and one file of episodes.
        repo_id: Repository id of the result.
        root: Folder of the result; must not exist yet.
    """
    first = LeRobotDatasetMetadata(repo_id, root=sources[0])
    merged = LeRobotDatasetMetadata.create(
        repo_id,
        first.fps,
        merge_video_feature_info_for_aggregate([first]),
        first.robot_type,
        root,
        use_videos=bool(first.video_keys),
    )
    tasks = [load_tasks(source) for source in sources]
    names = pd.concat(tasks).index.unique()
    merged.tasks = pd.DataFrame({"task_index": range(len(names))}, index=pd.Index(names, name="task"))
    episodes = [pd.read_parquet(source / EPISODES_DIR) for source in sources]

    videos: list[dict[str, Any]] = [{} for _ in sources]
    for key in merged.video_keys:
        _merge_videos(key, sources, episodes, merged, videos)
    data_places = _places_of_tables(DATA_DIR, sources, merged)
    data = _data_tables(sources, tasks, merged)
    _write(data, data_places, root, DEFAULT_DATA_PATH, to_parquet_one_row_group_per_episode)
    places = _places_of_tables(EPISODES_DIR, sources, merged)
    tables = _episode_tables(episodes, places, data_places, videos, merged)
    _write(tables, places, root, DEFAULT_EPISODES_PATH, pd.DataFrame.to_parquet)

    merged.info.total_tasks = len(names)
    merged.info.splits = {"train": f"0:{merged.info.total_episodes}"}
    write_tasks(merged.tasks, root)
    write_info(merged.info, root)
    # LeRobot returns them in a different order each time.
    stats = aggregate_stats([load_stats(source) for source in sources])
    write_stats(dict(sorted(stats.items())), root)


def _merge_videos(
    key: str,
    sources: list[Path],
    episodes: list[pd.DataFrame],
    merged: LeRobotDatasetMetadata,
    videos: list[dict[str, Any]],
) -> None:
    """Write the videos of the camera `key`, and note in `videos` where those of each source are now."""
    files: list[tuple[int, Place, Path]] = []
    for i, table in enumerate(episodes):
        columns = [f"videos/{key}/chunk_index", f"videos/{key}/file_index"]
        for chunk, file in sorted(set(table[columns].itertuples(index=False, name=None))):
            path = DEFAULT_VIDEO_PATH.format(video_key=key, chunk_index=chunk, file_index=file)
            files.append((i, (chunk, file), sources[i] / path))
        videos[i][key] = {
            "chunk": 0,
            "file": 0,
            "latest_duration": 0.0,
            "episode_duration": 0.0,
            "src_to_offset": {},
            "src_to_dst": {},
        }
    sizes = [get_file_size_in_mb(path) for *_, path in files]
    places = _places(sizes, merged.info.video_files_size_in_mb, merged.info.chunks_size)
    for place, members in groupby(zip(places, files, strict=True), key=itemgetter(0)):
        paths, seconds = [], 0.0
        for _, (i, source_place, path) in members:
            videos[i][key]["src_to_dst"][source_place] = place
            videos[i][key]["src_to_offset"][source_place] = seconds
            seconds += get_video_duration_in_s(path)
            paths.append(path)
        target = DEFAULT_VIDEO_PATH.format(video_key=key, chunk_index=place[0], file_index=place[1])
        concatenate_video_files(paths, merged.root / target, compatibility_check=True)


def _data_tables(
    sources: list[Path], tasks: list[pd.DataFrame], merged: LeRobotDatasetMetadata
) -> Iterator[pd.DataFrame]:
    """The rows of each source, numbered to follow those of the one before."""
    first_episode = first_frame = 0
    for source, source_tasks in zip(sources, tasks, strict=True):
        table = pd.read_parquet(source / DATA_DIR)
        table["episode_index"] += first_episode
        table["index"] += first_frame
        names = source_tasks.index.take(table["task_index"].to_numpy())
        table["task_index"] = merged.tasks.loc[names, "task_index"].to_numpy()
        first_episode = int(table["episode_index"].iloc[-1]) + 1
        first_frame += len(table)
        yield table


def _episode_tables(
    episodes: list[pd.DataFrame],
    places: list[Place],
    data_places: list[Place],
    videos: list[dict[str, Any]],
    merged: LeRobotDatasetMetadata,
) -> Iterator[pd.DataFrame]:
    """The episodes of each source, numbered to follow those counted in `merged`, and added to its counts."""
    for table, place, data_place, source_videos in zip(episodes, places, data_places, videos, strict=True):
        shifted = update_meta_data(
            table,
            merged,
            {"chunk": place[0], "file": place[1]},
            {"chunk": data_place[0], "file": data_place[1]},
            source_videos,
        )
        merged.info.total_episodes += len(table)
        merged.info.total_frames += int(table["length"].sum())
        yield shifted


def _places_of_tables(folder: str, sources: list[Path], merged: LeRobotDatasetMetadata) -> list[Place]:
    sizes = [
        sum(get_parquet_file_size_in_mb(file) for file in (source / folder).rglob("*.parquet"))
        for source in sources
    ]
    return _places(sizes, merged.info.data_files_size_in_mb, merged.info.chunks_size)


def _places(sizes: list[float], limit: float, chunk_size: int) -> list[Place]:
    """Where each source is written, given their sizes in MB: a new file begins where one would reach the limit."""
    places: list[Place] = []
    place, filled = (0, 0), 0.0
    for size in sizes:
        if places and filled + size >= limit:
            place, filled = update_chunk_file_indices(*place, chunk_size), 0.0
        filled += size
        places.append(place)
    return places


def _write(
    tables: Iterable[pd.DataFrame],
    places: list[Place],
    root: Path,
    pattern: str,
    to_parquet: Callable[[pd.DataFrame, Path], object],
) -> None:
    """Write consecutive tables with the same place into one file."""
    for (chunk, file), members in groupby(zip(places, tables, strict=True), key=itemgetter(0)):
        path = root / pattern.format(chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        to_parquet(pd.concat([table for _, table in members], ignore_index=True), path)

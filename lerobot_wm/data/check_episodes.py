"""The check of a dataset's tables of tasks and episodes."""

from pathlib import Path

import numpy as np
import pandas as pd
from lerobot.datasets.io_utils import load_episodes
from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR

from lerobot_wm.data.check_info import MEND, Info, one_line, read_file, shown
from lerobot_wm.data.check_tables import check_columns, first_difference, read_numbers, read_whole
from lerobot_wm.data.errors import DatasetError


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

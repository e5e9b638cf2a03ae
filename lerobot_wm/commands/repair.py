"""`lerobot-wm repair`: copy a dataset of LeRobot 2, or one whose frames LeRobot 3 would number or time otherwise."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import load_episodes, load_tasks, write_table_one_row_group_per_episode
from lerobot.datasets.utils import INFO_PATH, LEGACY_EPISODES_PATH, LEGACY_EPISODES_STATS_PATH, STATS_PATH
from lerobot.scripts.convert_dataset_v21_to_v30 import convert_dataset
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_wm.data.check import DatasetError
from lerobot_wm.data.source import SourceConfig, dataset_folder, open_dataset
from lerobot_wm.files import copy_dataset, new_folder
from lerobot_wm.system import quiet


@dataclass
class RepairConfig:
    """Flags of `lerobot-wm repair`.

    Args:
        dataset: The dataset, on this machine; it stays as it is.
        output_root: Folder of the repaired copy; must not exist yet.
    """

    dataset: SourceConfig
    output_root: Path


def repair(repo_id: str, root: Path, output_root: Path) -> None:
    """Write a copy in version 3, with `timestamp` = place in the episode / fps and with all columns that number frames.

    `index` is counted again. Other numbers that are there are kept.

    Raises:
        FileExistsError: `output_root` exists already.
        BlockingIOError: Another process is writing it.
        DatasetError: The copy would have other faults, such as missing files; nothing is written.
    """
    with new_folder(output_root) as copy, quiet():
        copy_dataset(root, copy)
        _convert(repo_id, copy)
        _number_frames(copy)
        open_dataset(repo_id, copy)


def _convert(repo_id: str, root: Path) -> None:
    """Convert a dataset of LeRobot 2 in place."""
    info = json.loads((root / INFO_PATH).read_text())
    if not info["codebase_version"].startswith("v2."):
        return
    needed = STATS_PATH if info["codebase_version"] == "v2.0" else LEGACY_EPISODES_STATS_PATH
    if not (root / needed).is_file():
        raise DatasetError(
            f"{repo_id} has no {needed}, which {info['codebase_version']} of LeRobot's format has: copy or download it "
            "again, or make it with the version of LeRobot that recorded the data."
        )
    if info["codebase_version"] == "v2.0":
        # LeRobot combines the statistics of all episodes, which version 2.0 lacks, into those of the dataset.
        stats = json.loads((root / STATS_PATH).read_text())
        lines = []
        for line in (root / LEGACY_EPISODES_PATH).read_text().splitlines():
            episode = json.loads(line)
            of_episode = {key: {**values, "count": [episode["length"]]} for key, values in stats.items()}
            lines.append(json.dumps({"episode_index": episode["episode_index"], "stats": of_episode}))
        (root / LEGACY_EPISODES_STATS_PATH).write_text("\n".join(lines) + "\n")
        (root / INFO_PATH).write_text(json.dumps({**info, "codebase_version": "v2.1"}))
    convert_dataset(repo_id, root=root, push_to_hub=False)
    # Where LeRobot's converter leaves what it converted.
    shutil.rmtree(root.with_name(f"{root.name}_old"))


def _number_frames(root: Path) -> None:
    """Time all frames, and add the columns that number them where they are missing."""
    info = json.loads((root / INFO_PATH).read_text())
    info["features"] = {**DEFAULT_FEATURES, **info["features"]}
    (root / INFO_PATH).write_text(json.dumps(info, indent=4))
    episodes = load_episodes(root).to_pandas()
    tasks = load_tasks(root)["task_index"]
    for (chunk, file), rows in episodes.groupby(["data/chunk_index", "data/file_index"]):
        path = root / info["data_path"].format(chunk_index=chunk, file_index=file)
        table = pq.read_table(path)
        lengths = rows["length"]
        frame = np.concatenate([np.arange(length) for length in lengths])
        if len(table) != len(frame):
            continue  # `open_dataset` names what is wrong
        numbers = {
            "frame_index": frame,
            "episode_index": np.repeat(rows["episode_index"], lengths),
            "index": np.repeat(rows["dataset_from_index"], lengths) + frame,
            "task_index": np.repeat([tasks[of_episode[0]] for of_episode in rows["tasks"]], lengths),
        }
        if "index" in table.column_names:
            table = table.drop_columns("index")
        for name, values in numbers.items():
            if name not in table.column_names:
                table = table.append_column(name, pa.array(np.asarray(values, np.int64)))
        times = (frame / info["fps"]).astype(np.float32)
        if "timestamp" in table.column_names:
            table = table.drop_columns("timestamp")
        write_table_one_row_group_per_episode(table.append_column("timestamp", pa.array(times)), path)


def main() -> None:
    """Entry point of `lerobot-wm repair`."""
    cfg = draccus.parse(RepairConfig)
    source = cfg.dataset
    root = dataset_folder(source.repo_id, source.root, source.revision)
    if root is None:
        raise FileNotFoundError(
            f"{source.repo_id} is not on this machine: download it, and give --dataset.root."
        )
    repair(source.repo_id, root, cfg.output_root)
    print(f"Repaired copy: {cfg.output_root}. Train on it with --dataset.root={cfg.output_root}")

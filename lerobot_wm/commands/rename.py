"""`lerobot-wm rename`: copy a dataset, with other names for its features.

LeRobot reads `action` and `observation.*`; converters for other libraries write names such as `actions` and `image`.
Both training commands take the copy.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import draccus
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import write_table_one_row_group_per_episode
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import EPISODES_DIR, INFO_PATH, STATS_PATH
from lerobot.utils.constants import DEFAULT_FEATURES

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.files import copy_dataset, new_folder


@dataclass
class RenameConfig:
    """Flags of `lerobot-wm rename`.

    Args:
        dataset: The dataset to copy.
        rename_map: New names of features: '{"image": "observation.images.top", "actions": "action"}'.
        output_repo_id: Repository id of the copy.
        output_root: Folder of the copy; must not exist yet.
    """

    dataset: SourceConfig
    rename_map: dict[str, str]
    output_repo_id: str
    output_root: Path


def rename(
    source: LeRobotDataset, rename_map: Mapping[str, str], output_repo_id: str, output_root: Path
) -> LeRobotDataset:
    """Write a copy of `source` whose features have other names; nothing else differs.

    Returns:
        The copy.

    Raises:
        FileExistsError: `output_root` exists already.
        BlockingIOError: Another process is writing it.
        ValueError: There is no such feature, it is one of LeRobot's own, or two would have the same name.
    """
    features = list(source.meta.features)
    if unknown := [key for key in rename_map if key not in features or key in DEFAULT_FEATURES]:
        raise ValueError(
            f"--rename_map: {source.repo_id} has no feature {', '.join(unknown)} that can be renamed; it has "
            f"{', '.join(key for key in features if key not in DEFAULT_FEATURES)}."
        )
    names = [rename_map.get(key, key) for key in features]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f"--rename_map: two features would be named {', '.join(twice)}. Give one another name."
        )
    with new_folder(output_root) as temporary:
        _write(Path(source.root), rename_map, temporary)
    return LeRobotDataset(output_repo_id, root=output_root)


def _write(root: Path, rename_map: Mapping[str, str], folder: Path) -> None:
    copy_dataset(root, folder, partial(_renamed, rename_map=rename_map))
    info = json.loads((folder / INFO_PATH).read_text(encoding="utf-8"))
    stats = json.loads((folder / STATS_PATH).read_text(encoding="utf-8"))
    info["features"] = _with_new_keys(info["features"], rename_map)
    for path, content in ((INFO_PATH, info), (STATS_PATH, _with_new_keys(stats, rename_map))):
        (folder / path).write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")
    for file in (folder / "data").rglob("*.parquet"):
        write_table_one_row_group_per_episode(_with_names(pq.read_table(file), rename_map), file)
    for file in (folder / EPISODES_DIR).rglob("*.parquet"):
        pq.write_table(_with_names(pq.read_table(file), rename_map), file)


def _with_new_keys(by_name: Mapping[str, Any], rename_map: Mapping[str, str]) -> dict[str, Any]:
    return {rename_map.get(name, name): value for name, value in by_name.items()}


def _renamed(name: str, rename_map: Mapping[str, str]) -> str:
    """The new name of a feature, or of what is named after it: stats/FEATURE/mean, videos/FEATURE/chunk-000."""
    parts = name.split("/")
    place = 1 if parts[0] in ("stats", "videos") else 0
    if len(parts) == 1 or place == 1:
        parts[place] = rename_map.get(parts[place], parts[place])
    return "/".join(parts)


def _with_names(table: pa.Table, rename_map: Mapping[str, str]) -> pa.Table:
    metadata = dict(table.schema.metadata or {})
    metadata.pop(b"pandas", None)  # it repeats the names of columns
    if b"huggingface" in metadata:  # the types with which `datasets` reads images and lists
        content = json.loads(metadata[b"huggingface"])
        content["info"]["features"] = _with_new_keys(content["info"]["features"], rename_map)
        metadata[b"huggingface"] = json.dumps(content).encode()
    names = [_renamed(name, rename_map) for name in table.column_names]
    return table.rename_columns(names).replace_schema_metadata(metadata)


def main() -> None:
    """Entry point of `lerobot-wm rename`."""
    cfg = draccus.parse(RenameConfig)
    dataset = rename(cfg.dataset.open(), cfg.rename_map, cfg.output_repo_id, cfg.output_root)
    print(f"{dataset.num_frames} frames, with {', '.join(cfg.rename_map.values())} -> {cfg.output_root}")

"""`lerobot-wm relabel`: a copy of a dataset whose `next.reward` is another of its columns.

Any policy type then learns from that reward, through both training commands.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import draccus
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import write_stats, write_table_one_row_group_per_episode
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from tqdm import tqdm

from lerobot_wm.constants import REWARD
from lerobot_wm.data.fingerprint import dataset_fingerprint
from lerobot_wm.data.lock import sole_writer
from lerobot_wm.data.schema import RELABEL_RECORD
from lerobot_wm.pipeline.source import SourceConfig


@dataclass
class RelabelConfig:
    """Flags of `lerobot-wm relabel`.

    Args:
        dataset: The dataset to copy.
        reward: The column that becomes `next.reward`, such as `next.dense_reward`. IQL on one that is above zero on the
            way to success needs `--policy.done_key=never`.
        output_repo_id: Repository id of the copy.
        output_root: Its folder; must not exist yet.
    """

    dataset: SourceConfig
    reward: str
    output_repo_id: str
    output_root: Path


def relabel(source: LeRobotDataset, reward: str, output_repo_id: str, output_root: Path) -> LeRobotDataset:
    """Write a copy of `source` with `next.reward` taken from the column `reward`; nothing else differs.

    `meta/relabel.json` says which column it was. The copy is written beside `output_root` and moved there when
    whole. LeRobot's `modify_features` cannot replace a feature, and leaves the statistics of episodes as they were.

    Returns:
        The copy.

    Raises:
        FileExistsError: `output_root` is there already.
        BlockingIOError: Another process writes it.
        ValueError: The dataset has no such column, or one of another kind than its `next.reward`.
    """
    kinds = {name: (feature["dtype"], *feature["shape"]) for name, feature in source.meta.features.items()}
    if reward not in kinds or kinds[reward] != kinds.get(REWARD):
        alike = [name for name in kinds if name.startswith("next.") and kinds[name] == kinds.get(REWARD)]
        raise ValueError(
            f"--reward={reward}: {source.repo_id} has no such column of the kind of its '{REWARD}', "
            f"{kinds.get(REWARD)}. Columns of that kind: {', '.join(alike) or 'none'}."
        )
    with sole_writer(output_root):
        if output_root.exists():
            raise FileExistsError(
                f"{output_root} is there already: choose another --output_root, or remove it."
            )
        _write(source, reward, output_root)
    return LeRobotDataset(output_repo_id, root=output_root)


def _write(source: LeRobotDataset, reward: str, output_root: Path) -> None:
    partial = output_root.with_name(f"{output_root.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    root = Path(source.root)
    files = [
        path for folder in ("meta", "data", "videos") for path in (root / folder).rglob("*") if path.is_file()
    ]
    for path in tqdm(files, desc="Copying", unit="file"):
        copy = partial / path.relative_to(root)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy)
    for file in (partial / "data").rglob("*.parquet"):
        write_table_one_row_group_per_episode(_with_columns(file, {REWARD: reward}), file)
    for file in (partial / "meta" / "episodes").rglob("*.parquet"):
        names = pq.read_schema(file).names
        of_reward = f"stats/{REWARD}/"
        sources = {name: name.replace(REWARD, reward) for name in names if name.startswith(of_reward)}
        pq.write_table(_with_columns(file, sources), file)
    write_stats({**source.meta.stats, REWARD: source.meta.stats[reward]}, partial)
    record = {
        "reward": reward,
        "source_repo_id": source.repo_id,
        "source_fingerprint": dataset_fingerprint(root),
    }
    (partial / RELABEL_RECORD).write_text(json.dumps(record, indent=2) + "\n")
    partial.replace(output_root)


def _with_columns(file: Path, sources: dict[str, str]) -> pa.Table:
    """A parquet file's table whose columns have the values of others: {column: the one it is taken from}."""
    table: pa.Table = pq.read_table(file)
    for name, source in sources.items():
        table = table.set_column(table.schema.get_field_index(name), name, table[source])
    return table


def main() -> None:
    """Entry point of `lerobot-wm relabel`."""
    cfg = draccus.parse(RelabelConfig)
    dataset = relabel(cfg.dataset.open(), cfg.reward, cfg.output_repo_id, cfg.output_root)
    print(f"{dataset.num_frames} frames with the reward {cfg.reward} -> {cfg.output_root}")

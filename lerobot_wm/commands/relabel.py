"""`lerobot-wm relabel`: copy a dataset, with another of its columns as `next.reward`.

Any policy type then learns from that reward, with both training commands.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import aggregate_stats, get_feature_stats
from lerobot.datasets.io_utils import write_stats, write_table_one_row_group_per_episode
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.constants import REWARD
from lerobot_wm.data.latents import dataset_fingerprint
from lerobot_wm.data.schema import RELABEL_RECORD
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.files import copy_dataset, new_folder


@dataclass
class RelabelConfig:
    """Flags of `lerobot-wm relabel`.

    Args:
        dataset: The dataset to copy.
        reward: The column that becomes `next.reward`, such as `next.dense_reward`. IQL needs
            `--policy.iql.done_key=never` with a reward that is above zero before success.
        output_repo_id: Repository id of the copy.
        output_root: Folder of the copy; must not exist yet.
    """

    dataset: SourceConfig
    reward: str
    output_repo_id: str
    output_root: Path


def relabel(source: LeRobotDataset, reward: str, output_repo_id: str, output_root: Path) -> LeRobotDataset:
    """Write a copy of `source` whose `next.reward` is the column `reward`; nothing else differs.

    `meta/relabel.json` names the column. LeRobot's `modify_features` cannot replace a feature, and does not update the
    statistics of episodes.

    Returns:
        The copy.

    Raises:
        FileExistsError: `output_root` exists already.
        BlockingIOError: Another process is writing it.
        ValueError: The dataset has no `next.reward`, or no such column of its type and shape.
    """
    kinds = {name: (feature["dtype"], *feature["shape"]) for name, feature in source.meta.features.items()}
    expected = kinds.get(REWARD)
    alike = [name for name, kind in kinds.items() if kind == expected]
    if reward not in alike:
        raise ValueError(
            f"--reward={reward}: {source.repo_id} has no such column of the type and shape of its '{REWARD}', "
            f"{expected or 'which it lacks'}. Columns of that type and shape: {', '.join(alike) or 'none'}. A policy "
            f"can also learn from a column under its own name: --policy.reward_key={reward}."
        )
    with new_folder(output_root) as temporary:
        _write(source, reward, temporary)
    return LeRobotDataset(output_repo_id, root=output_root)


def _write(source: LeRobotDataset, reward: str, folder: Path) -> None:
    root = Path(source.root)
    copy_dataset(root, folder)
    for file in (folder / "data").rglob("*.parquet"):
        table = pq.read_table(file)
        write_table_one_row_group_per_episode(_with_column(table, REWARD, table[reward]), file)
    episodes = _episode_stats(source, reward)
    for file in (folder / "meta" / "episodes").rglob("*.parquet"):
        table = pq.read_table(file)
        of_file = [episodes[index] for index in table["episode_index"].to_pylist()]
        for key in episodes[0]:
            name = f"stats/{REWARD}/{key}"
            if name in table.column_names:
                table = _with_column(table, name, pa.array([stats[key].tolist() for stats in of_file]))
        pq.write_table(table, file)
    of_all = aggregate_stats([{REWARD: stats} for stats in episodes])
    write_stats({**source.meta.stats, **of_all}, folder)
    record = {
        "reward": reward,
        "source_repo_id": source.repo_id,
        "source_fingerprint": dataset_fingerprint(root),
    }
    (folder / RELABEL_RECORD).write_text(json.dumps(record, indent=2) + "\n")


def _with_column(table: pa.Table, name: str, values: pa.ChunkedArray | pa.Array) -> pa.Table:
    """The table with other values in one of its columns, of the same type."""
    index = table.schema.get_field_index(name)
    return table.set_column(index, table.schema.field(index), values.cast(table.schema.field(index).type))


def _episode_stats(source: LeRobotDataset, column: str) -> list[dict[str, np.ndarray]]:
    """Statistics of a column in each episode: a column that LeRobot's `add_features` wrote has none yet."""
    values = np.stack(source.hf_dataset.with_format("numpy")[column][:]).reshape(len(source), -1)  # (N, 1)
    rows = (
        slice(episode["dataset_from_index"], episode["dataset_to_index"]) for episode in source.meta.episodes
    )
    return [get_feature_stats(values[row], axis=0, keepdims=False) for row in rows]


def main() -> None:
    """Entry point of `lerobot-wm relabel`."""
    cfg = draccus.parse(RelabelConfig)
    dataset = relabel(cfg.dataset.open(), cfg.reward, cfg.output_repo_id, cfg.output_root)
    print(f"{dataset.num_frames} frames with the reward {cfg.reward} -> {cfg.output_root}")

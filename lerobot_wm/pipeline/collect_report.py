"""What a collection did: meta/collection.json in the dataset, and a table on the screen."""

import json
from collections import Counter, defaultdict
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.envs.tasks import expert_name
from lerobot_wm.pipeline.collect_record import ShardRecord
from lerobot_wm.pipeline.collect_shards import versions


def write_collection_record(
    root: Path, config: dict[str, Any], records: list[ShardRecord], seconds: float
) -> None:
    """Write how a dataset came about into its meta folder; episodes are in dataset order.

    Args:
        root: the dataset's folder.
        config: what its content depends on.
        records: those of its shards, in order.
        seconds: wall time of the (last) run.
    """
    episodes = [asdict(episode) for record in records for episode in record.episodes]
    for index, episode in enumerate(episodes):
        episode["episode_index"] = index
    failures: dict[str, Counter[int]] = defaultdict(Counter)
    for record in records:
        failures[record.episodes[0].task].update(record.failures)
    content = {
        "config": config,
        "versions": versions(),
        "experts": {task: expert_name(task) for task in config["tasks"]},
        "failed_attempts": {
            task: dict(sorted(counts.items())) for task, counts in failures.items() if counts
        },
        "seconds": round(seconds, 1),
        "episodes": episodes,
    }
    (root / COLLECTION_RECORD).write_text(json.dumps(content, indent=1))


def print_summary(root: Path, records: list[ShardRecord], seconds: float) -> None:
    """Print a table per task.

    steps: mean length; failed: attempts that did not succeed; retried: episodes that needed more than
    one; moved: episodes collected on another variation than planned; seconds: of the workers together.
    """
    by_task: dict[str, list[ShardRecord]] = defaultdict(list)
    for record in records:
        by_task[record.episodes[0].task].append(record)
    table = Table(
        title=f"{root} in {seconds:.0f} s", title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0)
    )
    table.add_column("task", no_wrap=True)
    for column in ("episodes", "steps", "failed", "retried", "moved", "seconds"):
        table.add_column(column, justify="right", no_wrap=True)
    for task, task_records in by_task.items():
        episodes = [episode for record in task_records for episode in record.episodes]
        table.add_row(
            task,
            str(len(episodes)),
            f"{sum(episode.length for episode in episodes) / len(episodes):.1f}",
            str(sum(sum(record.failures.values()) for record in task_records)),
            str(sum(episode.attempt > 0 or episode.moved for episode in episodes)),
            str(sum(episode.moved for episode in episodes)),
            f"{sum(record.seconds for record in task_records):.0f}",
        )
    Console().print(table)

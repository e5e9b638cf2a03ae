"""`lerobot-wm collect`: demonstrations of Meta-World's scripted experts, collected in shards and merged."""

import json
import logging
import shutil
import time
from collections import Counter, defaultdict
from dataclasses import asdict
from functools import partial
from pathlib import Path

import draccus
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from rich import box
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from lerobot_wm.collect.card import push_demonstrations
from lerobot_wm.collect.config import CollectConfig, plan_shards
from lerobot_wm.collect.merge import merge_datasets
from lerobot_wm.collect.shards import Shard, ShardRecord, versions, write_shard
from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.envs.tasks import expert_name
from lerobot_wm.errors import cache_folders, check_can_push
from lerobot_wm.files import UNFINISHED, appears_whole, check_writable, sole_writer
from lerobot_wm.system import quiet, silence
from lerobot_wm.workers import Job, check_same_settings, map_in_workers, shards_folder


def collect(config: CollectConfig) -> Path:
    """Collect a dataset or one job's part of it, or resume an interrupted collection.

    Shards are written beside the dataset in `<root>.shards/`, merged, and removed. A folder with its final name is
    complete, so that a killed run loses at most the shards it was writing. A job with `shard` writes its own shards
    and merges nothing.

    Returns:
        The folder of the dataset, or of the shards for a job.

    Raises:
        FileExistsError: The folder has anything but this very dataset, or shards with other settings.
        BlockingIOError: Another process is collecting this dataset, or this job's part of it.
        ValueError: A flag names nothing that exists, or a shard is incomplete.
    """
    job = Job.parse(config.shard) if config.shard else None
    with sole_writer(config.output_root, job.lock_name if job else None):
        return _collect(config, job)


def _collect(config: CollectConfig, job: Job | None) -> Path:
    root = config.output_root
    folder = shards_folder(root)
    if _is_complete(config, root):
        # A run that was killed at its very end may have left the shards.
        shutil.rmtree(folder, ignore_errors=True)
        print(f"{root} is already complete.")
        return root
    # Merging reads the shards through this cache.
    check_writable(cache_folders()["HF_DATASETS_CACHE"])
    shards = plan_shards(config)
    mine = job.select(shards) if job else shards
    folder.mkdir(parents=True, exist_ok=True)
    if finished := _count_finished(shards, folder):
        print(f"{finished} of {len(shards)} shards are already in {folder}.")
    start = time.monotonic()
    with quiet():
        write_missing_shards(mine, folder, config.num_workers)
    if job:
        print(
            f"Job {config.shard} is done: {_count_finished(shards, folder)} of {len(shards)} shards are in {folder}. "
            "When all are there, the same command without --shard merges them."
        )
        return folder
    records = [ShardRecord.load(folder / shard.name) for shard in shards]
    print(f"Merging {len(shards)} shards")
    with appears_whole(root) as temporary:
        with quiet():
            merge_datasets([folder / shard.name for shard in shards], config.repo_id, temporary)
        seconds = time.monotonic() - start
        _write_record(temporary, config, records, seconds)
    shutil.rmtree(folder)
    _print_summary(root, records, seconds)
    return root


def _is_complete(config: CollectConfig, root: Path) -> bool:
    if not root.exists():
        return False
    record = root / COLLECTION_RECORD
    if not record.exists():
        raise FileExistsError(
            f"{root} exists and was not made by `lerobot-wm collect`: give another --root or remove it."
        )
    found = json.loads(record.read_text())["config"]
    check_same_settings(found, config.identity(), f"{root} is a dataset", "give another --root or remove it")
    return True


def _count_finished(shards: list[Shard], folder: Path) -> int:
    """Count the finished shards in a folder; other shards there are an error, as are incomplete ones."""
    planned = {shard.name: shard for shard in shards}
    fix = "use the same flags again, give another --root, or remove it"
    found = [path for path in sorted(folder.iterdir()) if path.suffix != UNFINISHED]
    for path in found:
        if path.name not in planned:
            raise FileExistsError(
                f"{path} is a shard of another collection, with other --tasks or more episodes: {fix}."
            )
        made_of = ShardRecord.load(path).made_of
        check_same_settings(made_of, planned[path.name].made_of(), f"{path} is a shard", fix)
    return len(found)


def write_missing_shards(shards: list[Shard], folder: Path, num_workers: int) -> None:
    """Write the shards that are not in `folder` yet, with a progress bar over all episodes."""
    missing = [shard for shard in shards if not (folder / shard.name).exists()]
    write = partial(write_shard, folder=folder)
    workers = min(num_workers, len(missing))
    written = map(write, missing) if workers <= 1 else map_in_workers(write, missing, workers, silence)
    total = sum(shard.count for shard in shards)
    done = total - sum(shard.count for shard in missing)
    with tqdm(total=total, initial=done, unit="episode", desc="collecting") as bar:
        for count in written:
            bar.update(count)


def _write_record(root: Path, config: CollectConfig, records: list[ShardRecord], seconds: float) -> None:
    """Write how the dataset was collected into its meta folder; episodes are in the dataset's order."""
    episodes = [asdict(episode) for record in records for episode in record.episodes]
    for index, episode in enumerate(episodes):
        episode["episode_index"] = index
    failures: dict[str, Counter[int]] = defaultdict(Counter)
    for record in records:
        failures[record.episodes[0].task].update(record.failures)
    identity = config.identity()
    content = {
        "config": identity,
        "versions": versions(),
        "experts": {task: expert_name(task) for task in identity["tasks"]},
        "failed_attempts": {
            task: dict(sorted(counts.items())) for task, counts in failures.items() if counts
        },
        "seconds": round(seconds, 1),
        "episodes": episodes,
    }
    (root / COLLECTION_RECORD).write_text(json.dumps(content, indent=1))


def _print_summary(root: Path, records: list[ShardRecord], seconds: float) -> None:
    """Print a table with a row per task.

    steps: mean length; failed: attempts without success; retried: episodes that needed more than one attempt; moved:
    episodes collected on another variation than planned; seconds: sum over all workers.
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


def push(config: CollectConfig) -> None:
    """Upload the complete dataset, with a card that says how it was collected."""
    record = json.loads((config.output_root / COLLECTION_RECORD).read_text())
    dataset = LeRobotDataset(config.repo_id, root=config.output_root)
    push_demonstrations(dataset, {**record, "config": config.identity()}, config.private, config.license)


def main() -> None:
    """Entry point of `lerobot-wm collect`."""
    logging.basicConfig(level=logging.WARNING)
    config = draccus.parse(CollectConfig)
    if config.push_to_hub:
        check_can_push(config.repo_id)
    collect(config)
    if config.push_to_hub and config.shard is None:
        push(config)


if __name__ == "__main__":
    main()

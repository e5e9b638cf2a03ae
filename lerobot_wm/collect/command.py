"""Writing shards, in this process or in several."""

import json
import logging
import multiprocessing
import shutil
import sys
import time
from collections import Counter, defaultdict
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from dataclasses import asdict
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any

import draccus
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from rich import box
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from lerobot_wm.collect.config import CollectConfig, plan_shards
from lerobot_wm.collect.merge import merge_datasets
from lerobot_wm.collect.shards import TEMPORARY_PREFIX, Shard, ShardRecord, versions, write_shard
from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.envs.tasks import expert_name
from lerobot_wm.errors import explained_to_parent
from lerobot_wm.files import sole_writer
from lerobot_wm.hub.dataset_card import push_demonstrations
from lerobot_wm.hub.errors import check_can_push
from lerobot_wm.quiet import quiet, silence
from lerobot_wm.system import Share, refuse_difference, shards_folder
from lerobot_wm.workers import end_with_parent, interrupts_held, workers_interrupted


def write_missing_shards(shards: list[Shard], folder: Path, num_workers: int) -> None:
    """Write the shards that `folder` does not hold yet, with a progress bar over all episodes."""
    missing = [shard for shard in shards if not (folder / shard.name).exists()]
    total = sum(shard.count for shard in shards)
    done = total - sum(shard.count for shard in missing)
    with tqdm(total=total, initial=done, unit="episode", desc="collecting") as bar:
        if num_workers == 1 or len(missing) <= 1:
            for shard in missing:
                write_shard(shard, folder, on_episode=bar.update)
        else:
            _write_in_parallel(missing, folder, min(num_workers, len(missing)), bar)


def _write_in_parallel(shards: list[Shard], folder: Path, num_workers: int, bar: tqdm) -> None:
    # Workers are forked from a server that has imported LeRobot once and holds no threads and no OpenGL.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["lerobot_wm.collect.command"])
    finished = context.SimpleQueue()
    with (
        ProcessPoolExecutor(num_workers, context, initializer=_start_worker, initargs=(finished,)) as pool,
        workers_interrupted(),
    ):
        with interrupts_held():
            pending = {pool.submit(_write_and_count, shard, folder) for shard in shards}
        while pending:
            done, pending = wait(pending, timeout=0.2, return_when=FIRST_EXCEPTION)
            while not finished.empty():
                finished.get()
                bar.update()
            if any(future.exception() is not None for future in done):
                pool.shutdown(cancel_futures=True)
            for future in done:
                future.result()


_episodes_saved: "SimpleQueue[None]"  # of a worker: one item per episode it has saved


def _start_worker(finished: "SimpleQueue[None]") -> None:
    global _episodes_saved
    _episodes_saved = finished
    end_with_parent()
    silence()


def _write_and_count(shard: Shard, folder: Path) -> None:
    with explained_to_parent():
        write_shard(shard, folder, on_episode=lambda: _episodes_saved.put(None))


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


def collect(config: CollectConfig) -> Path:
    """Collect a dataset or a job's share of it, or go on where that was interrupted.

    Shards are written beside the dataset in `<root>.shards/`, merged, and removed. A folder that appears
    under its final name is complete, so that a killed run loses at most the shards in work. A job with
    `shard` writes its own shards there and merges nothing.

    Returns:
        The dataset's folder; for a job that of the shards.

    Raises:
        FileExistsError: if the folder holds anything but this very dataset, or shards of other settings.
        BlockingIOError: if another process collects this dataset, or this share of it.
        ValueError: if there are more jobs than shards, or a shard was not copied whole.
    """
    with sole_writer(config.output_root, config.shard and config.shard.replace("/", "-of-")):
        return _collect(config)


def _collect(config: CollectConfig) -> Path:
    root = config.output_root
    folder = shards_folder(root)
    if _is_complete(config, root):
        shutil.rmtree(folder, ignore_errors=True)  # left by a run killed at its very end
        print(f"{root} is already complete.")
        return root
    shards = plan_shards(config)
    mine = Share.parse(config.shard).of(shards) if config.shard else shards
    folder.mkdir(parents=True, exist_ok=True)
    finished = _finished(shards, folder)
    if finished:
        print(f"{finished} of {len(shards)} shards are in {folder} already.")
    _remove_unfinished(mine, folder)
    start = time.monotonic()
    with quiet():
        write_missing_shards(mine, folder, config.num_workers)
    if config.shard:
        print(
            f"Job {config.shard} is done: {_finished(shards, folder)} of {len(shards)} shards are in {folder}. "
            "When all are there, the same command without --shard merges them."
        )
        return folder
    records = [ShardRecord.load(folder / shard.name) for shard in shards]
    merged = folder / f"{TEMPORARY_PREFIX}merged"
    shutil.rmtree(merged, ignore_errors=True)
    print(f"Merging {len(shards)} shards")
    with quiet():
        merge_datasets([folder / shard.name for shard in shards], config.repo_id, merged)
    seconds = time.monotonic() - start
    write_collection_record(merged, config.identity(), records, seconds)
    merged.rename(root)
    shutil.rmtree(folder)
    print_summary(root, records, seconds)
    return root


def push(config: CollectConfig) -> None:
    """Upload the finished dataset of a configuration, with a card that says how it came about."""
    record = json.loads((config.output_root / COLLECTION_RECORD).read_text())
    dataset = LeRobotDataset(config.repo_id, root=config.output_root)
    push_demonstrations(dataset, {**record, "config": config.identity()}, config.private, config.license)


def _is_complete(config: CollectConfig, root: Path) -> bool:
    if not root.exists():
        return False
    record = root / COLLECTION_RECORD
    if not record.exists():
        raise FileExistsError(
            f"{root} exists and was not made by `lerobot-wm collect`; give another --root or remove it."
        )
    found = json.loads(record.read_text())["config"]
    refuse_difference(found, config.identity(), f"{root} holds a dataset", "give another --root or remove it")
    return True


def _finished(shards: list[Shard], folder: Path) -> int:
    """How many of a collection's shards are finished in `folder`; refuse it where it holds any other, or a torn one."""
    planned = {shard.name: shard for shard in shards}
    mend = "repeat the flags it was made with, give another --root, or remove it"
    found = [path for path in sorted(folder.iterdir()) if not path.name.startswith(TEMPORARY_PREFIX)]
    for path in found:
        if path.name not in planned:
            raise FileExistsError(
                f"{path} is no shard of this collection: made with other --tasks or more episodes; {mend}."
            )
        made_of = ShardRecord.load(path).made_of
        refuse_difference(made_of, planned[path.name].made_of(), f"{path} is a shard", mend)
    return len(found)


def _remove_unfinished(shards: list[Shard], folder: Path) -> None:
    """Remove what killed runs left of these shards; those of other jobs may be in work."""
    for shard in shards:
        for unfinished in folder.glob(f"{TEMPORARY_PREFIX}{shard.name}-*"):
            shutil.rmtree(unfinished)


def main() -> None:
    """Entry point of `lerobot-wm collect`."""
    logging.basicConfig(level=logging.WARNING)
    try:
        config = draccus.parse(CollectConfig, args=sys.argv[1:])
        if config.push_to_hub:
            check_can_push(config.repo_id)
        collect(config)
    except draccus.ParsingError as error:
        # Why CollectConfig refused its flags is the cause.
        sys.exit(f"lerobot-wm collect: {error} {error.__cause__ or ''}")
    if config.push_to_hub and config.shard is None:
        push(config)


if __name__ == "__main__":
    main()

"""`lerobot-wm collect`: scripted Meta-World demonstrations as one LeRobotDataset."""

import json
import logging
import shutil
import sys
import time
from pathlib import Path

import draccus
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.lock import sole_writer
from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.hub.dataset_card import push_demonstrations
from lerobot_wm.hub.errors import check_can_push
from lerobot_wm.pipeline.collect_config import CollectConfig, plan_shards
from lerobot_wm.pipeline.collect_record import ShardRecord
from lerobot_wm.pipeline.collect_report import print_summary, write_collection_record
from lerobot_wm.pipeline.collect_shards import TEMPORARY_PREFIX, Shard
from lerobot_wm.pipeline.collect_workers import write_missing_shards
from lerobot_wm.pipeline.merge import merge_datasets
from lerobot_wm.pipeline.quiet import quiet
from lerobot_wm.pipeline.share import Share, refuse_difference, shards_folder


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

"""Writing shards, in this process or in several."""

import multiprocessing
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from multiprocessing.queues import SimpleQueue
from pathlib import Path

from tqdm import tqdm

from lerobot_wm.pipeline.collect_shards import Shard, write_shard
from lerobot_wm.pipeline.errors import explained_to_parent
from lerobot_wm.pipeline.quiet import silence
from lerobot_wm.pipeline.workers import end_with_parent, interrupts_held, workers_interrupted


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
    context.set_forkserver_preload(["lerobot_wm.pipeline.collect_workers"])
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


_finished: "SimpleQueue[None]"  # of a worker: one item per episode it has saved


def _start_worker(finished: "SimpleQueue[None]") -> None:
    global _finished
    _finished = finished
    end_with_parent()
    silence()


def _write_and_count(shard: Shard, folder: Path) -> None:
    with explained_to_parent():
        write_shard(shard, folder, on_episode=lambda: _finished.put(None))

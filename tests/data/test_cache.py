"""Frames decoded by several processes at once."""

from multiprocessing import get_context
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier
from pathlib import Path

from lerobot_wm.data.cache import CameraCache

PROCESSES, ROUNDS = 4, 25


def _open_and_mark(rank: int, folder: Path, together: Barrier, results: Queue) -> None:
    for number in range(ROUNDS):
        together.wait()
        frames = CameraCache._open(folder / f"{number}.npy", (PROCESSES,))
        frames[rank] = 1
        together.wait()
        results.put(int(frames.sum()))


def test_processes_that_start_together_share_one_file(tmp_path: Path) -> None:
    # Two trainings on a new dataset each created the frames file; the later rename left the earlier process writing
    # into a deleted file, while the flags of decoded episodes told the other that its frames were there.
    context = get_context("fork")
    together, results = context.Barrier(PROCESSES), context.Queue()
    processes = [
        context.Process(target=_open_and_mark, args=(rank, tmp_path, together, results))
        for rank in range(PROCESSES)
    ]
    for process in processes:
        process.start()
    seen = [results.get(timeout=60) for _ in range(PROCESSES * ROUNDS)]
    for process in processes:
        process.join()
    assert seen == [PROCESSES] * (PROCESSES * ROUNDS)
    assert not list(tmp_path.glob("*.tmp"))

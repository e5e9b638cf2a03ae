"""Worker processes that end with the command that started them, and jobs that share the work of one command."""

import json
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lerobot_wm.errors import WorkerError, line_for


def map_in_workers[Item, Result](
    function: Callable[[Item], Result],
    items: Sequence[Item],
    num_workers: int,
    start: Callable[..., None],
    *start_args: object,
) -> Iterator[Result]:
    """Apply a function to each item in new processes; results come in the order of the items.

    Args:
        function: A module-level function, because worker processes find it by its name.
        items: Its arguments.
        num_workers: Number of processes, at most one for each item; up to one, this process does the work.
        start: Called first in each new process.
        *start_args: Arguments of `start`.

    Raises:
        WorkerError: An error of a worker that is one line; others are raised as they are.
    """
    num_workers = min(num_workers, len(items))
    if num_workers <= 1:
        yield from map(function, items)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(num_workers, context, _start_worker, (start, start_args)) as pool:
        try:
            with delay_interrupts():
                results = pool.map(partial(_call, function), items)
            yield from results
        except (KeyboardInterrupt, GeneratorExit):
            # Instead of waiting for their work.
            for worker in multiprocessing.active_children():
                worker.terminate()
            raise


def _start_worker(start: Callable[..., None], start_args: tuple[object, ...]) -> None:
    # Otherwise a worker would outlive a killed parent, and keep writing into the output.
    threading.Thread(target=_end_with_parent, daemon=True).start()
    start(*start_args)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _call[Item, Result](function: Callable[[Item], Result], item: Item) -> Result:
    try:
        return function(item)
    except Exception as error:
        # A traceback does not reach the parent process, which could not tell where the error was raised.
        line = line_for(error)
        if line is None:
            raise
        raise WorkerError(line) from error


@contextmanager
def delay_signals(*numbers: signal.Signals) -> Iterator[None]:
    """Delay signals until the block has ended, such as while a child process is started that they must reach too.

    Blocking signals would not do: one that reaches another thread is still handled in the main thread.

    Args:
        *numbers: The signals; the first one that arrived is raised afterwards.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run only in the main thread
        return
    arrived: list[int] = []
    before = {
        number: signal.signal(number, lambda number, frame: arrived.append(number)) for number in numbers
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if arrived:
            signal.raise_signal(arrived[0])


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Delay Ctrl-C; processes that are started meanwhile never receive it and leave it to this one."""
    with delay_signals(signal.SIGINT):
        # New processes inherit the mask.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@dataclass(frozen=True)
class Job:
    """One of several jobs that share the work of a command (`--shard=i/n`).

    Attributes:
        index: Which one, counted from 1.
        count: Number of jobs.
    """

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Job":
        """Read "i/n".

        Raises:
            ValueError: The text has another form, or i is not one of 1 to n.
        """
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        index, count = (int(match[1]), int(match[2])) if match else (0, 0)
        if not 1 <= index <= count:
            raise ValueError(
                f"shard is {text!r}; expected i/n with i from 1 to n, such as 1/4 for the first of four jobs."
            )
        return cls(index, count)

    @property
    def lock_name(self) -> str:
        """Name of the job for `sole_writer`."""
        return f"{self.index}-of-{self.count}"

    def select[T](self, pieces: Sequence[T]) -> list[T]:
        """The pieces of work of this job: every n-th one, so that each job gets some of every task."""
        return list(pieces[self.index - 1 :: self.count])


def shards_folder(root: Path) -> Path:
    """Where the shards of the dataset `root` are kept until they are merged."""
    return root.with_name(f"{root.name}.shards")


def parts_folder(root: Path) -> Path:
    """Where the latents of the dataset `root` are kept until all are encoded."""
    return root.with_name(f"{root.name}.parts")


def check_same_settings(found: Mapping[str, Any], expected: Mapping[str, Any], what: str, fix: str) -> None:
    """Raise an error for work that was done with other settings.

    Args:
        found: Its settings, read from JSON.
        expected: The settings of this run.
        what: What was found, such as "x.shards/reach-v3-00000 is a shard".
        fix: What the user can do.

    Raises:
        FileExistsError: Names each setting that differs.
    """
    # Through JSON, so that both sides have its types.
    expected = json.loads(json.dumps(expected))
    different = [
        f"{name} {found.get(name)} there, {value} here"
        for name, value in expected.items()
        if found.get(name) != value
    ]
    if different:
        raise FileExistsError(f"{what} made with other settings ({'; '.join(different)}); {fix}.")

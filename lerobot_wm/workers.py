"""Worker processes that end with the command that started them."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial

from lerobot_wm.errors import explained_to_parent
from lerobot_wm.system import held_back


def map_in_workers[Item, Result](
    function: Callable[[Item], Result],
    items: Iterable[Item],
    num_workers: int,
    start: Callable[..., None],
    *start_args: object,
) -> Iterator[Result]:
    """`function` of each item, in the order of `items`, from new processes that end with this one.

    Args:
        function: Of a module, not of another function: processes find it by its name.
        items: What it is given, one by one.
        num_workers: Processes.
        start: What each does first.
        *start_args: What that is given.

    Raises:
        WorkerError: What a worker ended with, where that is one line; other errors as they are.
    """
    with (
        ProcessPoolExecutor(
            num_workers, multiprocessing.get_context("spawn"), _start_worker, (start, start_args)
        ) as pool,
        workers_interrupted(),
    ):
        with interrupts_held():
            results = pool.map(partial(_explained, function), items)
        yield from results


def _start_worker(start: Callable[..., None], start_args: tuple[object, ...]) -> None:
    end_with_parent()
    start(*start_args)


def _explained[Item, Result](function: Callable[[Item], Result], item: Item) -> Result:
    with explained_to_parent():
        return function(item)


def end_with_parent() -> None:
    """Have this worker end when its parent does, however that ends: it would write on into its output."""
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def interrupts_held() -> Iterator[None]:
    """Let Ctrl-C wait; processes started meanwhile never see it, and leave it to this one."""
    with held_back(signal.SIGINT):
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which they inherit
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def workers_interrupted() -> Iterator[None]:
    """On Ctrl-C, or where a generator is closed, end this process's workers instead of waiting for what they began."""
    try:
        yield
    except (KeyboardInterrupt, GeneratorExit):
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise

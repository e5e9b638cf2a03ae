"""A signal waits while workers are started."""

import os
import signal
import threading
import time

import pytest

from lerobot_wm.workers import delay_interrupts


def interrupted(finished: list[bool]) -> None:
    with delay_interrupts():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.2)
        finished.append(True)


def test_ctrl_c_waits_whichever_thread_it_reaches() -> None:
    """A thread from before, such as a progress bar's, does not block it."""
    over = threading.Event()
    bystander = threading.Thread(target=over.wait)
    bystander.start()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    finished = []
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted(finished)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()), "nothing stays blocked"
    finally:
        signal.signal(signal.SIGINT, before)
        over.set()
        bystander.join()
    assert finished


def test_workers_can_be_started_from_any_thread() -> None:
    errors = []

    def start() -> None:
        try:
            with delay_interrupts():
                pass
        except ValueError as error:
            errors.append(error)

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    assert not errors

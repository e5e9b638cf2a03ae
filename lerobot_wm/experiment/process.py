"""A stage at work: its subprocess, its log and its end."""

import os
import shlex
import signal
import subprocess
import time
from collections.abc import Sequence
from typing import IO

from lerobot_wm.experiment.stage import Stage

STOP_SECONDS = 20.0  # from being asked to end until being made to


class Running:
    """Starts a stage.

    Args:
        stage: What to run.
        cores: How many cores it may use.
        lock: Held open by the subprocess too: a lock on it lasts until the last stage has ended, also where
            this process was killed.
    """

    def __init__(self, stage: Stage, cores: int, lock: IO) -> None:
        self.stage = stage
        self.resumed = stage.resumes  # from a checkpoint: its time is that of a part
        self._started = time.monotonic()
        command = stage.command(cores)
        stage.prepare()
        with stage.log.open("a") as log:
            print("$", shlex.join(command), file=log, flush=True)
            # In a process group of its own: Ctrl-C reaches this process alone, which then ends the group.
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment(cores),
                process_group=0,
                pass_fds=(lock.fileno(),),
            )

    @property
    def returncode(self) -> int | None:
        """None while it runs."""
        return self._process.poll()

    @property
    def seconds(self) -> float:
        """Since its start."""
        return time.monotonic() - self._started

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to all its processes."""
        if self.returncode is None:
            os.killpg(self._process.pid, number)

    def wait(self, seconds: float | None = None) -> None:
        """Wait for its end.

        Raises:
            subprocess.TimeoutExpired: it runs on.
        """
        self._process.wait(seconds)


def stop(running: Sequence[Running]) -> None:
    """End stages: all are asked at once, and made to after a while."""
    for work in running:
        work.signal(signal.SIGTERM)
    end = time.monotonic() + STOP_SECONDS
    for work in running:
        try:
            work.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            work.signal(signal.SIGKILL)
            work.wait()


def environment(cores: int) -> dict[str, str]:
    """A stage's environment: its share of the cores, headless rendering, nothing fetched from the Hub."""
    variables = {"HF_HUB_OFFLINE": "1", "MUJOCO_GL": "egl", **os.environ, "OMP_NUM_THREADS": str(cores)}
    # Without bytecode files, which this variable forbids, each command spends seconds more on its imports.
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    return variables

"""Running stages side by side: the longest chains first, within the machine's cores."""

import json
import os
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import IO

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from lerobot_wm.experiment.stage import Stage
from lerobot_wm.files import write_whole
from lerobot_wm.workers import delay_signals


class Times:
    """`times.json`: {stage: {"kind", "seconds"}} for every stage that succeeded.

    Args:
        path: The file.
        expected: Minutes of each kind of stage, used until one has been measured.
    """

    def __init__(self, path: Path, expected: Mapping[str, float]) -> None:
        self._path = path
        self._expected = expected
        self._measured: dict[str, dict] = json.loads(path.read_text()) if path.is_file() else {}

    def record(self, stage: Stage, seconds: float) -> None:
        """Add a finished stage that ran from the beginning, not from a checkpoint."""
        self._measured[stage.name] = {"kind": stage.kind, "seconds": round(seconds, 1)}
        write_whole(self._path, json.dumps(self._measured, indent=1) + "\n")

    def minutes(self, kind: str) -> float:
        """How long a stage of this kind takes: the mean of those measured, else what the preset says.

        Other kinds, of arms that the preset leaves out, are taken to be as long as its mean one.
        """
        seconds = [entry["seconds"] for entry in self._measured.values() if entry["kind"] == kind]
        if seconds:
            return fmean(seconds) / 60
        return self._expected.get(kind, fmean(self._expected.values()))


def ranks(stages: Mapping[str, Stage], minutes: Mapping[str, float]) -> dict[str, float]:
    """Minutes from the start of each stage to the end of the longest chain of stages that wait for it.

    Args:
        stages: Each after those it needs.
        minutes: The expected time of each stage.

    Returns:
        The upward rank of list scheduling (Topcuoglu et al. 2002): the highest starts first.
    """
    after = dict.fromkeys(stages, 0.0)
    # Reversed, those that wait for a stage come before it.
    for name in reversed(list(stages)):
        for need in stages[name].needs:
            if need.name in after:
                after[need.name] = max(after[need.name], minutes[name] + after[name])
    return {name: minutes[name] + after[name] for name in stages}


def minutes_left(stages: Mapping[str, Stage], minutes: Mapping[str, float], processes: int) -> float:
    """A lower bound of the minutes that `processes` need: the longest chain, or their share of the sum."""
    longest = max(ranks(stages, minutes).values(), default=0.0)
    return max(longest, sum(minutes[name] for name in stages) / processes)


# From SIGTERM to SIGKILL.
STOP_SECONDS = 20.0


class StageProcess:
    """A stage's subprocess, started when this is created.

    Args:
        stage: What to run.
        cores: How many cores it may use.
        lock: The subprocess holds it open too: a lock on it lasts until the last stage has ended, even if this
            process is killed.
    """

    def __init__(self, stage: Stage, cores: int, lock: IO) -> None:
        self.stage = stage
        self.resumed = stage.is_resumable
        self.started = time.monotonic()
        command = stage.command(cores)
        stage.prepare()
        with stage.log.open("a") as log:
            print("$", shlex.join(command), file=log, flush=True)
            # In its own process group: Ctrl-C reaches only this process, which then stops the group.
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment(cores),
                process_group=0,
                pass_fds=(lock.fileno(),),
            )

    @property
    def seconds(self) -> float:
        """Since its start."""
        return time.monotonic() - self.started

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to all its processes."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, number)


def stop(running: Sequence[StageProcess]) -> None:
    """Terminate stages, and kill those that have not ended after `STOP_SECONDS`."""
    for work in running:
        work.signal(signal.SIGTERM)
    end = time.monotonic() + STOP_SECONDS
    for work in running:
        try:
            work.process.wait(max(0.0, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            work.signal(signal.SIGKILL)
            work.process.wait()


def environment(cores: int) -> dict[str, str]:
    """A stage's environment: its share of the cores, headless rendering, no access to the Hub."""
    variables = {"HF_HUB_OFFLINE": "1", "MUJOCO_GL": "egl", **os.environ, "OMP_NUM_THREADS": str(cores)}
    # This variable forbids bytecode files, without which each command takes seconds longer to import.
    variables.pop("PYTHONDONTWRITEBYTECODE", None)
    return variables


def minutes_text(minutes: float) -> str:
    """3.2 -> "3.2 min", 72 -> "1 h 12 min"."""
    return f"{minutes:.1f} min" if minutes < 60 else f"{minutes // 60:.0f} h {minutes % 60:.0f} min"


POLL_SECONDS = 0.2


class Runner:
    """Runs stages as subprocesses; prints when one starts or ends, and on a terminal shows those that run.

    Args:
        stages: Unfinished ones by name, each after those it needs.
        processes: How many run side by side at most.
        cores: Cores of the machine, shared by the stages that run side by side.
        times: Measured and expected wall times.
        console: Where progress is shown.
        on_finish: Called after each stage that succeeds.
    """

    def __init__(
        self,
        stages: Mapping[str, Stage],
        processes: int,
        cores: int,
        times: Times,
        console: Console,
        on_finish: Callable[[Stage], None],
    ) -> None:
        self._total, self._done = len(stages), 0
        self._waiting = dict(stages)
        self._running: list[StageProcess] = []
        self._failed: list[Stage] = []
        self._processes = processes
        self._cores = cores
        self._times = times
        self._console = console
        self._on_finish = on_finish
        self._ranks = ranks(stages, {name: times.minutes(stage.kind) for name, stage in stages.items()})

    def run(self, lock: IO) -> list[Stage]:
        """Run until nothing can run any more, and return the stages that failed.

        Stages that need a failed one do not run; the others do. Running stages are stopped if this call is interrupted.

        Args:
            lock: A file that every stage holds open.
        """
        try:
            with Live(console=self._console, refresh_per_second=2, transient=True) as live:
                while True:
                    self._reap()
                    self._start_ready(lock)
                    if not self._running:
                        return self._failed
                    live.update(self._progress())
                    time.sleep(POLL_SECONDS)
        finally:
            stop(self._running)

    def _start_ready(self, lock: IO) -> None:
        missing = {*self._waiting, *(stage.name for stage in self._failed)}
        missing |= {work.stage.name for work in self._running}
        ready = [
            stage for stage in self._waiting.values() if not missing & {need.name for need in stage.needs}
        ]
        ready.sort(key=lambda stage: -self._ranks[stage.name])
        side_by_side = min(self._processes, len(self._running) + len(ready))
        for stage in ready[: self._processes - len(self._running)]:
            self._print(f"{stage.name} {'resumes' if stage.is_resumable else 'starts'}; log: {stage.log}")
            with delay_signals(signal.SIGINT, signal.SIGTERM):
                self._running.append(StageProcess(stage, max(1, self._cores // side_by_side), lock))
            del self._waiting[stage.name]

    def _reap(self) -> None:
        for work in list(self._running):
            stage, returncode = work.stage, work.process.poll()
            if returncode is None:
                continue
            self._running.remove(work)
            if returncode == 0 and stage.is_finished:
                self._done += 1
                if not work.resumed:
                    self._times.record(stage, work.seconds)
                took = minutes_text(work.seconds / 60)
                self._print(f"[green]{stage.name} done[/] in {took} ({self._done}/{self._total})")
                self._on_finish(stage)
            else:
                self._failed.append(stage)
                why = f"exit code {returncode}" if returncode else f"it did not write {stage.artefact}"
                self._print(f"[red]{stage.name} failed[/] ({why})")

    def _print(self, line: str) -> None:
        self._console.print(line, highlight=False, soft_wrap=True)

    def _progress(self) -> Group:
        """The running stages, and how long the rest will take."""
        minutes = {name: self._times.minutes(stage.kind) for name, stage in self._waiting.items()}
        table = Table("running", "minutes", "of about", box=None)
        for work in self._running:
            expected, spent = self._times.minutes(work.stage.kind), work.seconds / 60
            table.add_row(work.stage.name, f"{spent:.1f}", f"{expected:.1f}")
            minutes[work.stage.name] = max(0.0, expected - spent)
        stages = {work.stage.name: work.stage for work in self._running} | self._waiting
        left = minutes_text(minutes_left(stages, minutes, self._processes))
        state = f"{self._done} of {self._total} stages done, {len(self._waiting)} waiting; about {left} left"
        return Group(table, Text(state))

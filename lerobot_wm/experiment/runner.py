"""Running stages side by side: in the order of what waits for them, within the machine's cores."""

import signal
import time
from collections.abc import Callable, Mapping
from typing import IO

from lerobot_wm.experiment.process import Running, stop
from lerobot_wm.experiment.progress import Progress
from lerobot_wm.experiment.stage import Stage
from lerobot_wm.experiment.times import Times, ranks
from lerobot_wm.pipeline.signals import held_back

POLL_SECONDS = 0.2


class Runner:
    """Runs stages as subprocesses.

    Args:
        stages: Unfinished ones by name, each after those it needs.
        processes: How many run side by side at most.
        cores: Cores of the machine; stages that run side by side share them.
        times: Measured and expected wall times.
        progress: Shows what goes on.
        on_finish: Called after each stage that ended well.

    Raises:
        ValueError: it is not known how long a kind of stage takes.
    """

    def __init__(
        self,
        stages: Mapping[str, Stage],
        processes: int,
        cores: int,
        times: Times,
        progress: Progress,
        on_finish: Callable[[Stage], None],
    ) -> None:
        self._waiting = dict(stages)
        self._running: list[Running] = []
        self._failed: list[Stage] = []
        self._processes = processes
        self._cores = cores
        self._times = times
        self._progress = progress
        self._on_finish = on_finish
        self._ranks = ranks(stages, {name: times.minutes(stage.kind) for name, stage in stages.items()})

    def run(self, lock: IO) -> list[Stage]:
        """Run until nothing can run any more; returns the stages that failed.

        A stage that fails takes those with it that need its result; the others go on. The stages at work end
        with this call, however it ends.

        Args:
            lock: A file that every stage holds open.
        """
        try:
            while True:
                self._reap()
                self._start_ready(lock)
                if not self._running:
                    return self._failed
                self._progress.show(self._running, self._waiting)
                time.sleep(POLL_SECONDS)
        finally:
            stop(self._running)

    def _start_ready(self, lock: IO) -> None:
        missing = {*self._waiting, *(stage.name for stage in self._failed)}
        missing |= {work.stage.name for work in self._running}
        ready = [
            stage for stage in self._waiting.values() if not missing & {need.name for need in stage.needs}
        ]
        ready.sort(key=lambda stage: -self._ranks[stage.name])  # first the one that most waits for
        side_by_side = min(self._processes, len(self._running) + len(ready))
        for stage in ready[: self._processes - len(self._running)]:
            self._progress.started(stage)
            with held_back(signal.SIGINT, signal.SIGTERM):
                self._running.append(Running(stage, max(1, self._cores // side_by_side), lock))
            del self._waiting[stage.name]

    def _reap(self) -> None:
        for work in list(self._running):
            if work.returncode is None:
                continue
            self._running.remove(work)
            if work.returncode == 0 and work.stage.finished:
                if not work.resumed:
                    self._times.note(work.stage, work.seconds)
                self._progress.finished(work.stage, work.seconds)
                self._on_finish(work.stage)
            else:
                self._failed.append(work.stage)
                self._progress.failed(work.stage, work.returncode)

"""What the experiment shows while it runs: stages done, running and left, and how long they may take."""

from collections.abc import Mapping, Sequence

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from lerobot_wm.experiment.process import Running
from lerobot_wm.experiment.stage import Stage
from lerobot_wm.experiment.times import Times, minutes_left


class Progress:
    """Lines for what starts and ends, and on a terminal a live view below them. A context manager."""

    def __init__(self, console: Console, times: Times, processes: int, total: int) -> None:
        self._console = console
        self._times = times
        self._processes = processes
        self._total = total
        self._done = 0
        self._live = Live(console=console, refresh_per_second=2, transient=True)

    def __enter__(self) -> "Progress":
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._live.stop()

    def started(self, stage: Stage) -> None:
        """Say that a stage starts, or where it goes on."""
        how = "goes on" if stage.resumes else "starts"
        self._console.print(f"{stage.name} {how}; log: {stage.log}", highlight=False, soft_wrap=True)

    def finished(self, stage: Stage, seconds: float) -> None:
        """Say that a stage ended well."""
        self._done += 1
        self._console.print(
            f"[green]{stage.name} done[/] in {minutes_text(seconds / 60)} ({self._done}/{self._total})",
            highlight=False,
        )

    def failed(self, stage: Stage, returncode: int) -> None:
        """Say that a stage failed."""
        why = f"exit code {returncode}" if returncode else f"it ended without writing {stage.artefact}"
        self._console.print(f"[red]{stage.name} failed[/] ({why})", highlight=False, soft_wrap=True)

    def show(self, running: Sequence[Running], waiting: Mapping[str, Stage]) -> None:
        """Renew the live view."""
        minutes = {name: self._times.minutes(stage.kind) for name, stage in waiting.items()}
        table = Table("running", "minutes", "of about", box=None)
        for work in running:
            expected, spent = self._times.minutes(work.stage.kind), work.seconds / 60
            table.add_row(work.stage.name, f"{spent:.1f}", f"{expected:.1f}")
            minutes[work.stage.name] = max(0.0, expected - spent)
        stages = {work.stage.name: work.stage for work in running} | dict(waiting)
        left = minutes_left(stages, minutes, self._processes)
        state = (
            f"{self._done} of {self._total} stages done, {len(waiting)} wait; about {minutes_text(left)} left"
        )
        self._live.update(Group(table, Text(state)))


def minutes_text(minutes: float) -> str:
    """3.2 -> "3.2 min", 72 -> "1 h 12 min"."""
    return f"{minutes:.1f} min" if minutes < 60 else f"{minutes // 60:.0f} h {minutes % 60:.0f} min"

"""A stage of the experiment: one command, and the file that says it is finished."""

import shutil
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Stage:
    """One subprocess of the experiment.

    Args:
        name: Unique within the experiment.
        kind: Stages of one kind take about as long.
        argv: Its command.
        folder: What it writes; a start from nothing removes it first.
        artefact: The file it writes last: there is one exactly when the stage is finished.
        needs: Stages that must be finished before.
        checkpoint: The file or folder a stopped stage goes on from; None when it has to start from nothing.
        is_there: Whether the checkpoint is; where a kill can leave it hidden, it is brought back first.
        resume_argv: The command to go on with; none where `argv` itself goes on.
        takes_workers: Whether it spreads over the cores it is given by `--num_workers`.
    """

    name: str
    kind: str
    argv: tuple[str, ...]
    folder: Path
    artefact: Path
    needs: tuple["Stage", ...] = ()
    checkpoint: Path | None = None
    is_there: Callable[[Path], bool] = Path.exists
    resume_argv: tuple[str, ...] = ()
    takes_workers: bool = False

    @property
    def log(self) -> Path:
        """What the command prints, beside what it writes."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def finished(self) -> bool:
        """Whether its artefact is there."""
        return self.artefact.exists()

    @property
    def resumes(self) -> bool:
        """Whether a stopped run of it left something to go on from."""
        return self.checkpoint is not None and self.is_there(self.checkpoint)

    def command(self, cores: int) -> list[str]:
        """The command to run now, with the cores it may use."""
        argv = self.resume_argv if self.resumes and self.resume_argv else self.argv
        return [*argv, f"--num_workers={cores}"] if self.takes_workers else list(argv)

    def prepare(self) -> None:
        """Make room: the folder of its log, and no left-overs where it starts from nothing."""
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        if not self.resumes and self.folder.exists():
            shutil.rmtree(self.folder)


def in_order(targets: Iterable[Stage]) -> dict[str, Stage]:
    """`targets` and all they need, by name, each after those it needs."""
    return _closure(targets, lambda stage: True)


def unfinished(targets: Iterable[Stage]) -> dict[str, Stage]:
    """The stages still to run for `targets`, by name, each after those it needs.

    What a finished stage needed is not looked at: it may have been removed since.
    """
    return _closure(targets, lambda stage: not stage.finished)


def _closure(targets: Iterable[Stage], wanted: Callable[[Stage], bool]) -> dict[str, Stage]:
    stages: dict[str, Stage] = {}

    def visit(stage: Stage) -> None:
        if stage.name not in stages and wanted(stage):
            for need in stage.needs:
                visit(need)
            stages[stage.name] = stage

    for target in targets:
        visit(target)
    return stages


def lerobot_wm(command: str, flags: Mapping[str, object], *more: str) -> tuple[str, ...]:
    """`lerobot-wm COMMAND --FLAG=VALUE ...` for the Python that runs this; `more` are flags written out."""
    written = (f"--{name}={value}" for name, value in flags.items())
    return (sys.executable, "-m", "lerobot_wm.cli", command, *written, *more)


@dataclass(frozen=True)
class Dataset:
    """A dataset that a stage makes."""

    made_by: Stage
    repo_id: str

    def flags(self, name: str = "dataset") -> dict[str, object]:
        """The flags that name it."""
        return {f"{name}.repo_id": self.repo_id, f"{name}.root": self.made_by.folder}


@dataclass(frozen=True)
class Checkpoint:
    """A policy or encoder that a stage makes."""

    made_by: Stage
    path: Path

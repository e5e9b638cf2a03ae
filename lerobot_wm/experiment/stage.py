"""A stage of the experiment: one command, and the file that shows that it is finished."""

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
        kind: Stages of one kind take about equally long.
        argv: Its command.
        folder: What it writes. It is removed before the stage starts from the beginning.
        artefact: The file it writes last; it exists exactly when the stage is finished.
        needs: Stages that must be finished before.
        checkpoint: The file or folder from which a stopped stage resumes; None where it starts from the beginning.
        can_resume: Whether the stage can resume from the checkpoint; writes nothing.
        resume_argv: The command that resumes it; empty where `argv` does that too.
        takes_workers: Whether it uses several cores by `--num_workers`.
    """

    name: str
    kind: str
    argv: tuple[str, ...]
    folder: Path
    artefact: Path
    needs: tuple["Stage", ...] = ()
    checkpoint: Path | None = None
    can_resume: Callable[[Path], bool] = Path.exists
    resume_argv: tuple[str, ...] = ()
    takes_workers: bool = False

    @property
    def log(self) -> Path:
        """What the command prints, beside what it writes."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def is_finished(self) -> bool:
        """Whether its artefact exists."""
        return self.artefact.exists()

    @property
    def is_resumable(self) -> bool:
        """Whether a stopped run of it left a checkpoint."""
        return self.checkpoint is not None and self.can_resume(self.checkpoint)

    def command(self, cores: int) -> list[str]:
        """The command to run now, with the cores it may use."""
        argv = self.resume_argv if self.is_resumable and self.resume_argv else self.argv
        return [*argv, f"--num_workers={cores}"] if self.takes_workers else list(argv)

    def prepare(self) -> None:
        """Create the folder of its log, and remove what an earlier run left unless it can be resumed."""
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        if not self.is_resumable and self.folder.exists():
            shutil.rmtree(self.folder)


def in_order(targets: Iterable[Stage], include_finished: bool = True) -> dict[str, Stage]:
    """`targets` and all stages they need, by name, each after those it needs.

    Args:
        targets: Last stages.
        include_finished: Without them, what a finished stage needed is left out too: it may have been removed since.
    """
    stages: dict[str, Stage] = {}

    def visit(stage: Stage) -> None:
        if stage.name not in stages and (include_finished or not stage.is_finished):
            for need in stage.needs:
                visit(need)
            stages[stage.name] = stage

    for target in targets:
        visit(target)
    return stages


def unfinished(targets: Iterable[Stage]) -> dict[str, Stage]:
    """The stages that must still run for `targets`, by name, each after those it needs."""
    return in_order(targets, include_finished=False)


def lerobot_wm(command: str, flags: Mapping[str, object], *more: str) -> tuple[str, ...]:
    """`lerobot-wm COMMAND --FLAG=VALUE ...` for this Python interpreter; `more` are complete flags."""
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

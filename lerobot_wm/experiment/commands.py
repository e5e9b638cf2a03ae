"""`lerobot-wm` command lines, and the names of what they write."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from lerobot_wm.experiment.stage import Stage


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

"""What a finished shard says of itself, in its `shard.json`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SHARD_RECORD = "shard.json"


@dataclass
class EpisodeRecord:
    """How an episode came about.

    Args:
        task: its task.
        episode: its number within the task.
        variation: the one it was collected on.
        moved: whether that is another than planned, the expert having failed there.
        attempt: failures on this variation before it.
        seed: entropy of the noise's np.random.SeedSequence.
        length: frames.
    """

    task: str
    episode: int
    variation: int
    moved: bool
    attempt: int
    seed: list[int]
    length: int


@dataclass
class ShardRecord:
    """A finished shard.

    Args:
        made_of: what its content depends on, as `Shard.made_of` says it.
        episodes: how each came about.
        failures: failed attempts by variation.
        seconds: wall time.
        files: bytes of each of its other files, by path.
    """

    made_of: dict[str, Any]
    episodes: list[EpisodeRecord]
    failures: dict[int, int]
    seconds: float
    files: dict[str, int]

    @classmethod
    def load(cls, folder: Path) -> "ShardRecord":
        """Read the record that lies in a finished shard.

        Raises:
            ValueError: it is missing, or a file it names is missing or cut short.
        """
        path = folder / SHARD_RECORD
        data = json.loads(path.read_text()) if path.exists() else {}
        if "files" not in data or not data["files"].items() <= file_sizes(folder).items():
            raise ValueError(
                f"{folder} is not a whole shard: copy it again, or remove it and it is collected."
            )
        return cls(
            made_of=data["made_of"],
            episodes=[EpisodeRecord(**episode) for episode in data["episodes"]],
            failures={int(variation): count for variation, count in data["failures"].items()},
            seconds=data["seconds"],
            files=data["files"],
        )


def file_sizes(folder: Path) -> dict[str, int]:
    """Bytes of each file of a shard but its record, by path."""
    return {
        path.relative_to(folder).as_posix(): path.stat().st_size
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != SHARD_RECORD
    }

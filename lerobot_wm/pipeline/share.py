"""`--shard=i/n`: one job's share of work that n jobs do together, on one machine or several; where shares gather."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Share:
    """The index-th of `count` shares; counted from 1."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Share":
        """Read i/n.

        Raises:
            ValueError: it is not of this form, or i is not one of 1 to n.
        """
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        if match is None:
            raise ValueError(f"shard is {text!r}; expected i/n, such as 1/4 for the first of four jobs.")
        index, count = int(match[1]), int(match[2])
        if not 1 <= index <= count:
            raise ValueError(
                f"shard is {text}; expected i from 1 to n, such as 1/4 for the first of four jobs."
            )
        return cls(index, count)

    def of[T](self, parts: Sequence[T]) -> list[T]:
        """This job's parts, as many of each stretch as the other jobs have.

        Raises:
            ValueError: there are fewer parts than jobs.
        """
        if len(parts) < self.count:
            raise ValueError(
                f"shard is {self.index}/{self.count}, but this work has only {len(parts)} parts: "
                f"start at most {len(parts)} jobs."
            )
        return list(parts[self.index - 1 :: self.count])


def shards_folder(root: Path) -> Path:
    """Where the shards of the collection of the dataset `root` lie until they are merged."""
    return root.with_name(f"{root.name}.shards")


def parts_folder(root: Path) -> Path:
    """Where the latents of the dataset `root` lie until all are encoded."""
    return root.with_name(f"{root.name}.parts")


def refuse_difference(found: Mapping[str, Any], expected: Mapping[str, Any], what: str, mend: str) -> None:
    """Refuse work that was done with other settings.

    Args:
        found: its settings, read from JSON.
        expected: those of this run.
        what: what was found, such as "x.shards/reach-v3-00000 is a shard".
        mend: what to do about it.

    Raises:
        FileExistsError: naming each setting that differs.
    """
    # Through JSON, so that both sides have its types.
    expected = json.loads(json.dumps(expected))
    different = [
        f"{name} {found.get(name)} there, {value} here"
        for name, value in expected.items()
        if found.get(name) != value
    ]
    if different:
        raise FileExistsError(f"{what} made with other settings ({'; '.join(different)}); {mend}.")

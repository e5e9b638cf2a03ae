"""Wall times of stages, for the estimate of what is left."""

import json
from collections.abc import Mapping
from pathlib import Path

from lerobot_wm.experiment.stage import Stage
from lerobot_wm.files import write_whole


class Times:
    """`times.json`: {stage: {"kind", "seconds"}} for every stage that ended well.

    Args:
        path: The file.
        expected: Minutes of each kind of stage, until one of them has been measured.
    """

    def __init__(self, path: Path, expected: Mapping[str, float]) -> None:
        self._path = path
        self._expected = expected
        self._measured: dict[str, dict] = json.loads(path.read_text()) if path.is_file() else {}

    def note(self, stage: Stage, seconds: float) -> None:
        """Add a finished stage, measured from its start: not one that went on from a checkpoint."""
        self._measured[stage.name] = {"kind": stage.kind, "seconds": round(seconds, 1)}
        write_whole(self._path, json.dumps(self._measured, indent=1) + "\n")

    def minutes(self, kind: str) -> float:
        """How long a stage of this kind takes: the mean of those measured, else what the preset states.

        Raises:
            ValueError: none was measured and the preset does not say.
        """
        seconds = [entry["seconds"] for entry in self._measured.values() if entry["kind"] == kind]
        if seconds:
            return sum(seconds) / len(seconds) / 60
        if kind not in self._expected:
            raise ValueError(f"The preset's experiment.json states no minutes for '{kind}'; add them there.")
        return self._expected[kind]


def ranks(stages: Mapping[str, Stage], minutes: Mapping[str, float]) -> dict[str, float]:
    """Minutes from the start of each stage to the end of the longest chain of stages that wait for it.

    Args:
        stages: In an order in which each comes after those it needs.
        minutes: Of each of them.

    Returns:
        The upward rank of list scheduling (Topcuoglu et al. 2002): the highest is to be started first.
    """
    after = dict.fromkeys(stages, 0.0)
    for name in reversed(list(stages)):  # those that wait for a stage come before it
        for need in stages[name].needs:
            if need.name in after:
                after[need.name] = max(after[need.name], minutes[name] + after[name])
    return {name: minutes[name] + after[name] for name in stages}


def minutes_left(stages: Mapping[str, Stage], minutes: Mapping[str, float], processes: int) -> float:
    """A lower bound of the minutes `processes` side by side need: the longest chain, or their share of the sum."""
    longest = max(ranks(stages, minutes).values(), default=0.0)
    return max(longest, sum(minutes[name] for name in stages) / processes)

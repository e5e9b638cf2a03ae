"""Which variations fail: a grid of arms x variations per task, with the videos that were kept."""

from dataclasses import dataclass

from lerobot_wm.report.arms import by_arm
from lerobot_wm.report.records import Record, by_task
from lerobot_wm.report.videos import Clip


@dataclass(frozen=True)
class Outcome:
    """The rollouts of one arm on one variation, one per training seed."""

    successes: int
    n: int
    clip: Clip | None

    @property
    def kind(self) -> str:
        """ "success" or "failure" of all, or "mixed"."""
        if self.successes == self.n:
            return "success"
        return "mixed" if self.successes else "failure"


@dataclass(frozen=True)
class OutcomeGrid:
    """One task: a row of outcomes per arm, None where a variation was not rolled out."""

    task: str
    variations: list[int]
    n_seen: int  # how many of the variations, the first ones, occur in the training data
    rows: list[tuple[str, list[Outcome | None]]]


def outcome_grids(records: list[Record], clips: list[Clip]) -> list[OutcomeGrid]:
    """A grid for each task; of several videos of a cell the first is shown."""
    videos: dict[tuple[str, str, int], Clip] = {}
    for clip in clips:
        videos.setdefault((clip.arm, clip.task, clip.variation), clip)
    grids = []
    for task, of_task in by_task(records).items():
        seen = {record["variation"] for record in of_task if record["seen"]}
        others = {record["variation"] for record in of_task} - seen
        variations = [*sorted(seen), *sorted(others)]
        rows: list[tuple[str, list[Outcome | None]]] = []
        for arm, of_arm in by_arm(of_task).items():
            results: dict[int, list[bool]] = {}
            for record in of_arm:
                results.setdefault(record["variation"], []).append(record["success"])
            cells = [
                Outcome(sum(results[v]), len(results[v]), videos.get((arm, task, v)))
                if v in results
                else None
                for v in variations
            ]
            rows.append((arm, cells))
        grids.append(OutcomeGrid(task, variations, len(seen), rows))
    return grids

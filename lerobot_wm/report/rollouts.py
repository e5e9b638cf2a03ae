"""Rollouts on the page: videos of `lerobot-wm eval`, and which variations succeed and fail."""

import json
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from lerobot_wm.constants import EVAL_INFO_NAME
from lerobot_wm.inspect.pictures import MP4, data_uri
from lerobot_wm.records import Record, group_by_task
from lerobot_wm.report.comparison import group_by_arm

# Of all videos together; as data URIs they take a third more. 500 steps at 256x256 take 150 kB.
MAX_VIDEO_BYTES = 12_000_000


@dataclass(frozen=True)
class Clip:
    """One rollout's video."""

    arm: str
    task: str
    variation: int
    success: bool
    path: Path

    @property
    def src(self) -> str:
        """The video as a data URI."""
        return data_uri(self.path.read_bytes(), MP4)

    @property
    def caption(self) -> str:
        """What it shows."""
        result = "success" if self.success else "failure"
        return f"{self.task}, {self.arm}, variation {self.variation}: {result}"


@dataclass(frozen=True)
class Evaluation:
    """What the page shows of one `lerobot-wm eval`: what produced it (see `records.provenance`), and its videos."""

    provenance: dict[str, str]
    clips: list[Clip]


def read_evaluation(folder: Path) -> Evaluation:
    """Read an output folder of `lerobot-wm eval`.

    Raises:
        FileNotFoundError: The folder is not the output of `lerobot-wm eval`.
    """
    path = folder / EVAL_INFO_NAME
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing: --videos takes output folders of `lerobot-wm eval`.")
    info = json.loads(path.read_text())
    clips = []
    for video in sorted(folder.glob("videos/*/*.mp4")):
        name = re.fullmatch(r"variation_(\d+)_(success|failure)", video.stem)
        if name is not None:
            clips.append(Clip(info["arm"], video.parent.name, int(name[1]), name[2] == "success", video))
    return Evaluation(info["provenance"], clips)


def within_limit(clips: list[Clip]) -> list[Clip]:
    """The videos that fit in `MAX_VIDEO_BYTES`: failures first, and arms and tasks in turn."""
    taken: Counter[tuple[str, str, bool]] = Counter()
    turns = []
    for clip in clips:
        group = (clip.arm, clip.task, clip.success)
        turns.append((clip.success, taken[group]))
        taken[group] += 1
    chosen, room = [], MAX_VIDEO_BYTES
    for _, clip in sorted(zip(turns, clips, strict=True), key=lambda pair: pair[0]):
        size = clip.path.stat().st_size
        if size <= room:
            chosen.append(clip)
            room -= size
    return chosen


@dataclass(frozen=True)
class GridCell:
    """The rollouts of one arm on one variation, one per training seed, and a video of one of them."""

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
class Grid:
    """One task: a row of cells per arm, None where a variation was not rolled out.

    `n_seen` of the variations, which come first, are in the training data.
    """

    task: str
    variations: list[int]
    n_seen: int
    rows: list[tuple[str, list[GridCell | None]]]


def make_grids(records: list[Record], clips: list[Clip]) -> list[Grid]:
    """A grid for each task; a cell shows the first of its videos."""
    videos: dict[tuple[str, str, int], Clip] = {}
    for clip in clips:
        videos.setdefault((clip.arm, clip.task, clip.variation), clip)
    grids = []
    for task, of_task in group_by_task(records).items():
        seen = {record["variation"] for record in of_task if record["seen"]}
        others = {record["variation"] for record in of_task} - seen
        variations = [*sorted(seen), *sorted(others)]
        rows: list[tuple[str, list[GridCell | None]]] = []
        for arm, of_arm in group_by_arm(of_task).items():
            results: dict[int, list[bool]] = {}
            for record in of_arm:
                results.setdefault(record["variation"], []).append(record["success"])
            cells = [
                GridCell(sum(results[v]), len(results[v]), videos.get((arm, task, v)))
                if v in results
                else None
                for v in variations
            ]
            rows.append((arm, cells))
        grids.append(Grid(task, variations, len(seen), rows))
    return grids

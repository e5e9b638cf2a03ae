"""Rollout videos of `lerobot-wm eval` for the page."""

import json
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from lerobot_wm.constants import EVAL_INFO_NAME
from lerobot_wm.inspect.html import MP4, data_uri

# All videos of the grid together; as data URIs they take a third more. 500 steps at 256x256 take 150 kB.
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
        outcome = "success" if self.success else "failure"
        return f"{self.task}, {self.arm}, variation {self.variation}: {outcome}"


@dataclass(frozen=True)
class Evaluation:
    """What the page shows of one `lerobot-wm eval`: what made it, its command among that, and its videos."""

    provenance: dict[str, str]
    clips: list[Clip]


def read_evaluation(folder: Path) -> Evaluation:
    """Read an evaluation's output folder.

    Raises:
        FileNotFoundError: the folder is not the output of `lerobot-wm eval`.
        ValueError: a video has a name that `lerobot-wm eval` does not give.
    """
    path = folder / EVAL_INFO_NAME
    if not path.exists():
        raise FileNotFoundError(f"{path} is missing: --videos takes output folders of `lerobot-wm eval`.")
    info = json.loads(path.read_text())
    clips = []
    for video in sorted(folder.glob("videos/*/*.mp4")):
        name = re.fullmatch(r"variation_(\d+)_(success|failure)", video.stem)
        if name is None:
            raise ValueError(
                f"{video} is not named as `lerobot-wm eval` names videos: remove it from {folder}."
            )
        clips.append(Clip(info["arm"], video.parent.name, int(name[1]), name[2] == "success", video))
    return Evaluation(info["provenance"], clips)


def within_limit(clips: list[Clip]) -> list[Clip]:
    """The videos that `MAX_VIDEO_BYTES` leaves room for: failures first, and of each arm and task in turn."""
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

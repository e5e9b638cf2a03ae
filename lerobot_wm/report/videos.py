"""Rollout videos of `lerobot-wm eval` for the page."""

import json
import logging
import re
from dataclasses import dataclass
from pathlib import Path

from lerobot_wm.report.inline import MP4, data_uri

logger = logging.getLogger(__name__)

# Larger files would make the page unwieldy; 500 steps at 256x256 take 150 kB.
MAX_INLINE_BYTES = 4_000_000


@dataclass(frozen=True)
class Clip:
    """One rollout's video; `outcome` is "success" or "failure", `src` a data URI."""

    arm: str
    task: str
    variation: int
    outcome: str
    src: str


@dataclass(frozen=True)
class Evaluation:
    """What the page shows of one `lerobot-wm eval`: its command and its videos."""

    command: str
    clips: list[Clip]


def read_evaluation(folder: Path) -> Evaluation:
    """Read an evaluation's output folder; videos too large to inline are left out with a warning.

    Raises:
        FileNotFoundError: the folder is not the output of `lerobot-wm eval`.
    """
    path = folder / "eval_info.json"
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
        if video.stat().st_size > MAX_INLINE_BYTES:
            logger.warning("%s is larger than %d bytes: not on the page.", video, MAX_INLINE_BYTES)
            continue
        src = data_uri(video.read_bytes(), MP4)
        clips.append(Clip(info["arm"], video.parent.name, int(name[1]), name[2], src))
    return Evaluation(info["provenance"]["command"], clips)

"""The settings an output folder was made with, so that changed ones are not mixed into it."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_wm.experiment.arms import ARMS
from lerobot_wm.experiment.preset import PRESET_FILE, Preset
from lerobot_wm.files import write_whole

SETTINGS_NAME = "settings.json"

_ARMS = "arms"  # in that file, beside the names of the preset's

_CHANGE_NOTHING_MADE = ("arms", "minutes", "videos_per_task")  # of experiment.json


def check_settings(preset: Preset, output_dir: Path) -> None:
    """Note a preset's settings in the folder it writes to; refuse one that was made with others.

    What is finished there is not made again: with changed settings, tables would join results of both.

    Args:
        preset: Its settings files are read.
        output_dir: Where everything is written; made if it is not there.

    Raises:
        ValueError: Names the file, what has changed, and how to go on.
    """
    path = output_dir / SETTINGS_NAME
    known: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.is_file() else {}
    now = {file.name: json.loads(file.read_text()) for file in sorted(preset.folder.glob("*.json"))}
    for name in _CHANGE_NOTHING_MADE:
        now[PRESET_FILE].pop(name)
    for file, settings in now.items():
        before = known.get(file, settings)
        changed = [key for key in {**before, **settings} if before.get(key) != settings.get(key)]
        if changed:
            raise ValueError(_refusal(output_dir, changed, preset.folder / file))
    arms = json.loads(
        json.dumps({name: asdict(arm) for name, arm in ARMS.items()})
    )  # as the earlier ones are read
    before = known.get(_ARMS, {})
    changed = [
        name for name in arms if before.get(name, arms[name]) != arms[name]
    ]  # a new one changes nothing
    if changed:
        raise ValueError(_refusal(output_dir, changed, Path("lerobot_wm/experiment/arms.py")))
    write_whole(path, json.dumps(known | now | {_ARMS: arms}, indent=1) + "\n")


def _refusal(output_dir: Path, changed: list[str], file: Path) -> str:
    return (
        f"{output_dir} was made with other settings: {', '.join(changed)} of {file}. Set them back or give another "
        "--output_dir; or remove there what depends on them, the own_records*.jsonl among it, and "
        f"{output_dir / SETTINGS_NAME}."
    )

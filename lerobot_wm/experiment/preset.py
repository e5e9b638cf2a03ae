"""Presets: the size of an experiment, as `configs/<preset>/experiment.json` beside its training settings."""

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from lerobot_wm.constants import NUM_VARIATIONS
from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.experiment.arms import ARMS, WM_IQL_IN_SWEEP, Arm
from lerobot_wm.files import write_whole

CONFIGS = Path("configs")
PRESET_FILE = "experiment.json"


@dataclass(frozen=True)
class Preset:
    """What all arms of an experiment share.

    Args:
        folder: Where it was read from; its name is the preset's.
        tasks: A task set or a comma-separated list.
        episodes_per_task: Demonstrations of each task.
        noise: Standard deviation of the noise on the expert's actions.
        camera_name: The simulator's camera, or several separated by commas.
        first_eval_seed: Variation of each task's first rollout.
        rollouts_per_task: Rollouts of each task, on that variation and those after it.
        episode_length: Steps after which a rollout is a failure.
        videos_per_task: Rollouts of each task that are filmed, the first ones.
        arms: Arms run when none are named, each with its training seeds.
        minutes: Wall time expected of each kind of stage, until one of them has been measured.
    """

    folder: Path
    tasks: str
    episodes_per_task: int
    noise: float
    camera_name: str
    first_eval_seed: int
    rollouts_per_task: int
    episode_length: int
    videos_per_task: int
    arms: dict[str, list[int]]
    minutes: dict[str, float]

    @property
    def name(self) -> str:
        """As in records."""
        return self.folder.name

    @property
    def task_names(self) -> tuple[str, ...]:
        """The tasks one by one."""
        return resolve_tasks(self.tasks)

    @property
    def variations(self) -> list[int]:
        """The variations of each task's rollouts."""
        seeds = range(self.first_eval_seed, self.first_eval_seed + self.rollouts_per_task)
        return [seed % NUM_VARIATIONS for seed in seeds]

    def settings(self, config: str) -> Path:
        """A training settings file.

        Raises:
            FileNotFoundError: the preset has none of this name.
        """
        path = self.folder / f"{config}.json"
        if not path.is_file():
            raise FileNotFoundError(f"The preset '{self.name}' has no {path}: add it, or leave out its arms.")
        return path


def load_preset(name: str, configs: Path = CONFIGS) -> Preset:
    """Read a preset.

    Raises:
        FileNotFoundError: there is none of this name.
        ValueError: its fields are not those of `Preset`, or it names an unknown arm.
    """
    path = configs / name / PRESET_FILE
    if not path.is_file():
        found = sorted(file.parent.name for file in configs.glob(f"*/{PRESET_FILE}"))
        raise FileNotFoundError(f"No preset '{name}': {path} is missing; there are {', '.join(found)}.")
    data = json.loads(path.read_text())
    expected = {field.name for field in fields(Preset)} - {"folder"}
    if set(data) != expected:
        wrong = sorted(set(data) ^ expected)
        raise ValueError(f"{path} lacks or has too many of {wrong}; expected {sorted(expected)}.")
    preset = Preset(folder=path.parent, **data)
    for arm in preset.arms:
        known_arm(arm)
    return preset


def known_arm(name: str) -> Arm:
    """The arm of this name.

    Raises:
        ValueError: there is none.
    """
    if name not in ARMS:
        raise ValueError(f"No arm '{name}'; there are {', '.join(ARMS)}.")
    return ARMS[name]


def select_runs(preset: Preset, arms: list[str], seeds: list[int]) -> list[tuple[Arm, int]]:
    """Every (arm, seed) asked for, in the order of tables; `wm_iql` is that of the sweep where there is one.

    Args:
        preset: Gives the arms and the seeds that are not named.
        arms: Names; the preset's when empty.
        seeds: Training seeds of all of them; the preset's, or 0 where it has none, when empty. The scripted
            expert is not trained and runs once.

    Raises:
        ValueError: an arm is unknown.
    """
    wanted = {known_arm(name).name for name in arms or preset.arms}
    runs = [
        (arm, seed)
        for name, arm in ARMS.items()
        if name in wanted
        for seed in ([0] if arm.config is None else seeds or preset.arms.get(name, [0]))
    ]
    with_sweep = {seed for arm, seed in runs if arm.training == WM_IQL_IN_SWEEP.training}
    return [
        (WM_IQL_IN_SWEEP if arm.name == WM_IQL_IN_SWEEP.name and seed in with_sweep else arm, seed)
        for arm, seed in runs
    ]


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

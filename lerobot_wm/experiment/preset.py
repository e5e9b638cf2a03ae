"""Presets: the sizes of an experiment and its training settings, one file `configs/<preset>.json` each."""

import json
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from lerobot_wm.constants import NUM_SEEN_VARIATIONS, NUM_VARIATIONS, REPORTED_VARIATION_SET
from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.files import write_whole
from lerobot_wm.report.arms import ARMS, TRAININGS, WM_IQL_IN_SWEEP, Arm

CONFIGS = Path("configs")


@dataclass(frozen=True)
class Preset:
    """What all arms of an experiment share, as its file says.

    In the file, the keys of `arms` and `trainings` are names or patterns (`*_bc*`). All entries that match a name apply
    to it; where they differ, the last one counts.

    Args:
        name: As in records: the file's name.
        tasks: A task set or a comma-separated list.
        episodes_per_task: Demonstrations of each task.
        variations: Variations of set 42 with demonstrations.
        variation_set: The set of variations of the rollouts.
        noise: Standard deviation of the noise on the expert's actions.
        camera_name: The simulator's camera, or several separated by commas.
        first_eval_seed: Variation of each task's first rollout.
        rollouts_per_task: Rollouts of each task, on that variation and those after it.
        episode_length: Steps after which a rollout is a failure.
        videos_per_task: Rollouts of each task that are filmed, the first ones.
        arms: Arms that run by default, each with its training seeds; without seeds, an arm runs only when named.
        trainings: Settings of `lerobot-wm train` by name, complete but for dataset, seed and folder.
        minutes: Expected wall time of each kind of stage, used until one has been measured.
    """

    name: str
    tasks: str
    episodes_per_task: int
    noise: float
    camera_name: str
    first_eval_seed: int
    rollouts_per_task: int
    episode_length: int
    videos_per_task: int
    arms: dict[str, list[int]]
    trainings: dict[str, dict[str, Any]]
    minutes: dict[str, float]
    variations: str = f"0-{NUM_SEEN_VARIATIONS - 1}"
    variation_set: int = REPORTED_VARIATION_SET

    @property
    def task_names(self) -> tuple[str, ...]:
        """The tasks one by one."""
        return resolve_tasks(self.tasks)

    @property
    def rollout_variations(self) -> list[int]:
        """The variations of each task's rollouts."""
        seeds = range(self.first_eval_seed, self.first_eval_seed + self.rollouts_per_task)
        return [seed % NUM_VARIATIONS for seed in seeds]


def load_preset(name: str, configs: Path = CONFIGS) -> Preset:
    """Read a preset.

    Raises:
        ValueError: A pattern matches nothing, so that its settings would have no effect.
    """
    path = configs / f"{name}.json"
    data = json.loads(path.read_text())
    for table, names in (("arms", ARMS), ("trainings", TRAININGS)):
        for pattern in data[table]:
            if not any(fnmatchcase(known, pattern) for known in names):
                raise ValueError(f"{path}: '{pattern}' in '{table}' matches none of {', '.join(names)}.")
    data["arms"] = {arm: seeds[-1] for arm in ARMS if (seeds := _matching(data["arms"], arm)) and seeds[-1]}
    trainings = {}
    for training, policy in TRAININGS.items():
        settings: dict[str, Any] = {"policy": {**policy, "push_to_hub": False}}
        for changes in _matching(data["trainings"], training):
            settings = _merged(settings, changes)
        trainings[training] = settings
    return Preset(name=name, **data | {"trainings": trainings})


def _matching[T](table: dict[str, T], name: str) -> list[T]:
    """The entries whose key, a name or a pattern, matches a name."""
    return [value for pattern, value in table.items() if fnmatchcase(name, pattern)]


def _merged(settings: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    nested = {
        key: _merged(settings[key], value)
        for key, value in changes.items()
        if isinstance(value, dict) and key in settings
    }
    return settings | changes | nested


def select_runs(preset: Preset, arms: list[str], seeds: list[int]) -> list[tuple[Arm, int]]:
    """Every (arm, seed) that is asked for, in the order of tables. `wm_iql` shares the sweep's critics if there is one.

    Args:
        preset: Gives the arms and the seeds that are not named.
        arms: Names; the preset's when empty.
        seeds: Training seeds of all of them; the preset's, or 0 where it has none, when empty. The scripted
            expert is not trained and runs once.

    Raises:
        ValueError: An arm is unknown.
    """
    wanted = set(arms or preset.arms)
    if unknown := wanted - set(ARMS):
        raise ValueError(f"No arm {', '.join(sorted(unknown))}. Arms are {', '.join(ARMS)}.")
    runs = [
        (arm, seed)
        for name, arm in ARMS.items()
        if name in wanted
        for seed in ([0] if arm.training is None else seeds or preset.arms.get(name, [0]))
    ]
    with_sweep = {seed for arm, seed in runs if arm.run == WM_IQL_IN_SWEEP.run}
    return [
        (WM_IQL_IN_SWEEP if arm.name == WM_IQL_IN_SWEEP.name and seed in with_sweep else arm, seed)
        for arm, seed in runs
    ]


SETTINGS_NAME = "settings.json"


def config_file(output_dir: Path, training: str) -> Path:
    """Where `write_settings` puts the `--config_path` of a training."""
    return output_dir / "configs" / f"{training}.json"


def write_settings(preset: Preset, output_dir: Path) -> None:
    """Write the resolved settings of an experiment into its folder, unless it was made with different ones.

    Finished stages are not repeated, so after a change the tables would mix results of both settings. What changes no
    result is not compared: which arms run, filmed rollouts, expected minutes, descriptions.

    Args:
        preset: Its settings.
        output_dir: Where everything is written; created if needed.

    Raises:
        ValueError: Settings have changed; names them.
    """
    sizes = {key: value for key, value in vars(preset).items() if not isinstance(value, dict)}
    arms = {name: {**asdict(arm), "description": ""} for name, arm in ARMS.items()}
    del sizes["videos_per_task"]
    # Through JSON, as the earlier settings.
    now = json.loads(json.dumps({"sizes": sizes, "trainings": preset.trainings, "arms": arms}))
    path = output_dir / SETTINGS_NAME
    known = json.loads(path.read_text()) if path.is_file() else {}
    changed = [
        f"{section}.{name}"
        for section, entries in now.items()
        for name, value in entries.items()
        # A new entry changes nothing that exists.
        if known.get(section, {}).get(name, value) != value
    ]
    if changed:
        raise ValueError(
            f"{output_dir} was made with other settings of {', '.join(changed)}: compare {path} with the preset "
            f"'{preset.name}' and report/arms.py. Change them back or use another --output_dir. To keep the folder, "
            f"delete {path}, own_records*.jsonl and all results that depend on these settings."
        )
    write_whole(path, json.dumps(now, indent=1) + "\n")
    for training, settings in preset.trainings.items():
        write_whole(config_file(output_dir, training), json.dumps(settings, indent=2) + "\n")

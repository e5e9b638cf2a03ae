"""Meta-World task names: task sets, LeRobot's task strings, ids and scripted experts."""

import difflib
import functools
import json
from collections.abc import Iterable
from importlib import resources
from typing import TypedDict

from lerobot_wm.constants import ML45_TEST, MT6, MT10

PUSH_BACK_DESCRIPTION = "Push the puck back to a goal"


class _TaskTables(TypedDict):
    TASK_DESCRIPTIONS: dict[str, str]
    TASK_NAME_TO_ID: dict[str, int]
    DIFFICULTY_TO_TASKS: dict[str, list[str]]
    TASK_POLICY_MAPPING: dict[str, str]


@functools.cache
def _tables() -> _TaskTables:
    # Read as a file, because importing lerobot.envs.metaworld would import mujoco and all experts.
    return json.loads(resources.files("lerobot").joinpath("envs", "metaworld_config.json").read_text())


@functools.cache
def all_tasks() -> tuple[str, ...]:
    """All 50 Meta-World v3 task names, in the order of LeRobot's task ids."""
    ids = _tables()["TASK_NAME_TO_ID"]
    return tuple(sorted(ids, key=ids.__getitem__))


@functools.cache
def task_sets() -> dict[str, tuple[str, ...]]:
    """The tasks of each set that has a name on the command line."""
    ml45 = tuple(task for task in all_tasks() if task not in ML45_TEST)
    return {"mt6": MT6, "mt10": MT10, "mt50": all_tasks(), "ml45": ml45, "ml45_test": ML45_TEST}


def resolve_tasks(spec: str) -> tuple[str, ...]:
    """Turn a task argument into task names.

    Args:
        spec: A task (`reach-v3`), a set (`mt6`, `mt10`, `mt50`, `ml45`, `ml45_test`) or a comma-separated list of
            either.

    Returns:
        Task names in the given order, each once.

    Raises:
        ValueError: The argument is empty, or a name is unknown; suggests the closest names.
    """
    sets = task_sets()
    names = [name.strip() for name in spec.split(",") if name.strip()]
    if not names:
        raise ValueError(f"No task in '{spec}': give a task such as reach-v3, a list, or {_or(sets)}.")
    tasks: dict[str, None] = {}  # an ordered set
    for name in names:
        if name not in sets and name not in all_tasks():
            close = difflib.get_close_matches(name, [*all_tasks(), *sets], n=3, cutoff=0.5)
            hint = f"did you mean {_or(close)}?" if close else f"tasks are {', '.join(all_tasks())}."
            raise ValueError(f"Unknown Meta-World task '{name}' (task sets: {_or(sets)}); {hint}")
        tasks.update(dict.fromkeys(sets.get(name, (name,))))
    return tuple(tasks)


def task_description(task: str) -> str:
    """The sentence by which policies tell tasks apart: LeRobot's, but for push-back-v3, to which it gives push-v3's."""
    return PUSH_BACK_DESCRIPTION if task == "push-back-v3" else _tables()["TASK_DESCRIPTIONS"][task]


def tasks_by_tier() -> dict[str, list[str]]:
    """All 50 tasks by difficulty, from easy to very hard, as LeRobot's page on Meta-World groups them."""
    return {tier.replace("_", " "): tasks for tier, tasks in _tables()["DIFFICULTY_TO_TASKS"].items()}


def task_id(task: str) -> int:
    """LeRobot's index of a task, 0 to 49."""
    return _tables()["TASK_NAME_TO_ID"][task]


def expert_name(task: str) -> str:
    """Name of the class in `metaworld.policies` with the scripted expert of a task."""
    return _tables()["TASK_POLICY_MAPPING"][task]


def _or(names: Iterable[str]) -> str:
    return " or ".join(names)

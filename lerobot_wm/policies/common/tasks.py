"""Tasks of a dataset and of a policy, by their sentences."""

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


def check_tasks(config: Any, names: Iterable[str]) -> None:
    """Check that an acting policy of this configuration was trained on the tasks of these names.

    Raises:
        ValueError: A task is unknown; names it and the known ones.
    """
    unknown = set(names) - set(config.known_tasks)
    if unknown:
        raise ValueError(
            f"Unknown task {sorted(unknown)}; this policy was trained on {config.known_tasks}. Use one of these "
            "strings, or continue training with --policy.path on a dataset that has the new task."
        )


def task_names(dataset_meta: LeRobotDatasetMetadata) -> list[str]:
    """The task strings of a dataset, in order of task_index."""
    return [str(task) for task in dataset_meta.tasks.index]


_EPISODES: ContextVar[Collection[int] | None] = ContextVar("episodes", default=None)


@contextmanager
def only_episodes(episodes: Collection[int] | None) -> Iterator[None]:
    """Let policies that are made here know `--dataset.episodes`, which LeRobot does not tell them; None for all."""
    token = _EPISODES.set(episodes)
    try:
        yield
    finally:
        _EPISODES.reset(token)


def tasks_to_learn(dataset_meta: LeRobotDatasetMetadata) -> list[str]:
    """The tasks of a dataset, in order of task_index; inside `only_episodes`, those of the chosen episodes."""
    names, episodes = task_names(dataset_meta), _EPISODES.get()
    if episodes is None:
        return names
    of_episodes = dataset_meta.episodes["tasks"][:]
    chosen = {task for episode in episodes for task in of_episodes[episode]}
    return [name for name in names if name in chosen]

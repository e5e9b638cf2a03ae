"""Tasks of a dataset and of a policy, by their sentences."""

import json
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.constants import TASK_ID
from lerobot_wm.data.tables import episode_values


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
    """The tasks of a dataset, in order of task_index; inside `only_episodes`, those of the chosen episodes.

    Raises:
        ValueError: Two tasks would be learned as one.
    """
    names, episodes = task_names(dataset_meta), _EPISODES.get()
    _check_sentences(dataset_meta, names, episodes)
    if episodes is None:
        return names
    of_episodes = dataset_meta.episodes["tasks"][:]
    chosen = {task for episode in episodes for task in of_episodes[episode]}
    return [name for name in names if name in chosen]


def _check_sentences(
    dataset_meta: LeRobotDatasetMetadata, names: list[str], episodes: Collection[int] | None
) -> None:
    """Check that each sentence belongs to one `task_id`, where the dataset has this column.

    In lerobot/metaworld_mt50, push-v3 and push-back-v3 share theirs.
    """
    sharing: dict[int, dict[int, list[int]]] = {}  # sentence -> task_id -> episodes
    for episode, sentence, number in episode_values(dataset_meta, "task_index", TASK_ID):
        if episodes is None or episode in episodes:
            sharing.setdefault(sentence, {}).setdefault(number, []).append(episode)
    for sentence, by_number in sharing.items():
        if len(by_number) == 1:
            continue
        first, *_, last = by_number
        sentences = json.dumps({str(episode): "ANOTHER SENTENCE" for episode in by_number[last]})
        command = (
            f"lerobot-edit-dataset --repo_id={dataset_meta.repo_id} --root={dataset_meta.root} "
            f"--operation.type=modify_tasks --operation.episode_tasks='{sentences}'"
        )
        raise ValueError(
            f"{dataset_meta.repo_id}: tasks {first} and {last} of the column {TASK_ID} share the sentence "
            f"{names[sentence]!r}, by which a policy tells tasks apart. Give one of them another: `{command}`; or "
            "choose the --dataset.episodes of one in `lerobot-wm train`."
        )

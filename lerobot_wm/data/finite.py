"""NaN and infinite numbers in a dataset, which LeRobot reads and writes without a word."""

from collections.abc import Mapping, Sequence

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_wm.constants import ACTION
from lerobot_wm.data.errors import DatasetError
from lerobot_wm.data.tables import column_tensor

_READ = (ACTION, "observation.", "next.")  # beginnings of the names of all that is learned from


def check_finite_dataset(dataset: LeRobotDataset) -> None:
    """Refuse a dataset with a number that is not finite among its observations, actions and rewards.

    Raises:
        DatasetError: See `check_finite_columns`.
    """
    features = dataset.meta.features
    wanted = [key for key in features if key.startswith(_READ) and features[key]["dtype"].startswith("float")]
    columns = {
        key: column_tensor(dataset.hf_dataset, key, tuple(features[key]["shape"]))
        for key in (*wanted, "task_index", "episode_index", "frame_index")
    }
    check_finite_columns(columns, [str(task) for task in dataset.meta.tasks.index], dataset.repo_id)


def check_finite_columns(columns: Mapping[str, Tensor], tasks: Sequence[str], repo_id: str) -> None:
    """Refuse observations, actions and rewards with a number that is not finite.

    Args:
        columns: (N, ...) each, `task_index`, `episode_index` and `frame_index` (N,) among them.
        tasks: Task strings by task_index.
        repo_id: The dataset's name, for the message.

    Raises:
        DatasetError: Naming the column, the task, the episode and the frame.
    """
    for key, values in columns.items():
        if not key.startswith(_READ) or not values.is_floating_point():
            continue
        finite = values.isfinite().flatten(1).all(1) if values.ndim > 1 else values.isfinite()  # (N,)
        if finite.all():
            continue
        row = int(finite.int().argmin())
        task, episode, frame = (
            int(columns[name][row]) for name in ("task_index", "episode_index", "frame_index")
        )
        raise DatasetError(
            f"{repo_id}: {key} holds NaN or Inf in episode {episode} (task {tasks[task]!r}), frame {frame}: nothing "
            "can be learned from it. Remove the episode with lerobot-edit-dataset, or record it again; or remove the "
            "feature there, if no policy is to read it."
        )

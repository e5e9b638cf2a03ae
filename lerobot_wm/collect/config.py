"""The flags of `lerobot-wm collect`, and the shards that they plan."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from huggingface_hub.utils import validate_repo_id
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_wm.collect.shards import SHARD_EPISODES, Shard
from lerobot_wm.constants import CAMERA_NAME, IMAGE_SIZE, REPORTED_VARIATION_SET
from lerobot_wm.envs.cameras import parse_cameras
from lerobot_wm.envs.tasks import resolve_tasks, tasks_of_one_description
from lerobot_wm.envs.variations import check_variation_set, parse_variations


@dataclass
class CollectConfig:
    """Collect successful demonstrations of Meta-World's scripted experts into a LeRobotDataset."""

    # Name of the dataset, as user/name.
    repo_id: str
    # Folder of the dataset; by default LeRobot's own place for repo_id.
    root: Path | None = None
    # A task, a set (mt6, mt10, mt50) or a comma-separated list.
    tasks: str = "mt6"
    # Successful episodes to collect of each task, spread evenly over the variations.
    episodes_per_task: int = 130
    # Variations to collect on: ranges and numbers from 0 to 49, such as 0-9 or 0-4,7.
    variations: str = "0-9"
    # Set of variations: 42 for training and reported results, 43 for choosing settings and for probes, or 44.
    variation_set: int = REPORTED_VARIATION_SET
    # Standard deviation of the Gaussian noise added to the expert's clipped actions.
    noise: float = 0.3
    # Steps kept after the first success, so that successful observations are in the data.
    steps_after_success: int = 8
    # Attempts at a variation before its episode is collected on the next one.
    max_attempts: int = 5
    # Height and width of the images in pixels.
    image_size: int = IMAGE_SIZE
    # A camera of the simulator, or several separated by commas: corner2,topview.
    camera_name: str = CAMERA_NAME
    # Seed of the noise; the same seed gives the same dataset for any num_workers.
    seed: int = 0
    # Processes that collect in parallel.
    num_workers: int = 2
    # Which of several jobs this is: 1/4 is the first of four. Each job writes its part of the shards into
    # `<root>.shards`; when all are in one folder, the same command without this flag merges them.
    shard: str | None = None
    # Upload the dataset as repo_id when it is complete, even if an earlier run completed it.
    push_to_hub: bool = False
    # Upload to a private repository.
    private: bool = False
    # Licence of the uploaded dataset, as the Hub names it.
    license: str = "apache-2.0"

    def __post_init__(self) -> None:
        """Check a name that becomes a folder."""
        if self.root is None:
            validate_repo_id(self.repo_id)

    @property
    def output_root(self) -> Path:
        """The dataset's folder."""
        return Path(self.root) if self.root is not None else HF_LEROBOT_HOME / self.repo_id

    def identity(self) -> dict[str, Any]:
        """All settings that the content of the dataset depends on."""
        return {
            "tasks": list(resolve_tasks(self.tasks)),
            "episodes_per_task": self.episodes_per_task,
            "variation_set": self.variation_set,
            "variations": list(parse_variations(self.variations)),
            "noise": self.noise,
            "steps_after_success": self.steps_after_success,
            "max_attempts": self.max_attempts,
            "image_size": self.image_size,
            "camera_name": ",".join(parse_cameras(self.camera_name)),
            "seed": self.seed,
        }


def plan_shards(config: CollectConfig) -> list[Shard]:
    """The shards of a collection in the order of the final dataset: by task, then by episode.

    Raises:
        ValueError: There is no such task, variation or camera, or two tasks would become one task of the dataset.
    """
    tasks, variations = resolve_tasks(config.tasks), parse_variations(config.variations)
    check_variation_set(config.variation_set)
    for description, (first_task, *others) in tasks_of_one_description(tasks).items():
        kept = ",".join(task for task in tasks if task not in others)
        raise ValueError(
            f"{first_task} and {', '.join(others)} have one description, {description!r}, and would become one task of "
            f"the dataset. Collect {', '.join(others)} into another dataset, and here --tasks={kept}."
        )
    return [
        Shard(
            task=task,
            first=first,
            count=min(SHARD_EPISODES, config.episodes_per_task - first),
            variation_set=config.variation_set,
            variations=variations,
            noise=config.noise,
            steps_after_success=config.steps_after_success,
            max_attempts=config.max_attempts,
            seed=config.seed,
            image_size=config.image_size,
            cameras=parse_cameras(config.camera_name),
        )
        for task in tasks
        for first in range(0, config.episodes_per_task, SHARD_EPISODES)
    ]

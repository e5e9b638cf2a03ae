"""`lerobot-wm collect`: scripted Meta-World demonstrations as one LeRobotDataset."""

import json
import logging
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
from lerobot.utils.constants import HF_LEROBOT_HOME

from lerobot_wm.constants import CAMERA_NAME, IMAGE_SIZE, MAX_EPISODE_STEPS, REPORTED_VARIATION_SET
from lerobot_wm.envs.cameras import parse_cameras
from lerobot_wm.envs.tasks import resolve_tasks
from lerobot_wm.envs.variations import check_variation_set, parse_variations
from lerobot_wm.pipeline.collect_report import (
    COLLECTION_RECORD,
    print_summary,
    versions,
    write_collection_record,
)
from lerobot_wm.pipeline.collect_shards import (
    SHARD_EPISODES,
    TEMPORARY_PREFIX,
    Shard,
    ShardRecord,
    merge_shards,
)
from lerobot_wm.pipeline.collect_workers import write_missing_shards
from lerobot_wm.pipeline.quiet import quiet


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
    # Set of variations: 42, on which policies are trained and reported, or 43, for choosing settings and for probes.
    variation_set: int = REPORTED_VARIATION_SET
    # Standard deviation of the Gaussian noise added to the expert's clipped actions.
    noise: float = 0.3
    # Steps kept after the first success, so that successful observations are in the data.
    steps_after_success: int = 8
    # Attempts at a variation before its episode is given to the next variation.
    max_attempts: int = 5
    # Height and width of the images in pixels.
    image_size: int = IMAGE_SIZE
    # A camera of the simulator, or several separated by commas: corner2,topview.
    camera_name: str = CAMERA_NAME
    # Seed of the noise; the dataset is the same for a seed whatever num_workers.
    seed: int = 0
    # Processes that collect in parallel.
    num_workers: int = 2

    def __post_init__(self) -> None:
        """Check every field."""
        resolve_tasks(self.tasks)
        parse_variations(self.variations)
        check_variation_set(self.variation_set)
        parse_cameras(self.camera_name)
        limits = {
            "episodes_per_task": (1, None),
            "noise": (0, None),
            "steps_after_success": (0, MAX_EPISODE_STEPS),
            "max_attempts": (1, None),
            "image_size": (16, None),
            "seed": (0, None),
            "num_workers": (1, None),
        }
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if value < low or (high is not None and value > high):
                limit = f"at least {low}" if high is None else f"{low} to {high}"
                raise ValueError(f"{name} is {value}; expected {limit}.")

    @property
    def output_root(self) -> Path:
        """The dataset's folder."""
        return Path(self.root) if self.root is not None else HF_LEROBOT_HOME / self.repo_id

    def identity(self) -> dict[str, Any]:
        """Everything the content of the dataset depends on."""
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
    """The shards of a collection in the order of the final dataset: by task, then by episode."""
    return [
        Shard(
            task=task,
            first=first,
            count=min(SHARD_EPISODES, config.episodes_per_task - first),
            variation_set=config.variation_set,
            variations=parse_variations(config.variations),
            noise=config.noise,
            steps_after_success=config.steps_after_success,
            max_attempts=config.max_attempts,
            seed=config.seed,
            image_size=config.image_size,
            cameras=parse_cameras(config.camera_name),
        )
        for task in resolve_tasks(config.tasks)
        for first in range(0, config.episodes_per_task, SHARD_EPISODES)
    ]


def collect(config: CollectConfig) -> Path:
    """Collect a dataset, or go on with one that was interrupted; returns its folder.

    Shards are written beside the dataset in `<root>.shards/`, merged, and removed. A folder that appears
    under its final name is complete, so that a killed run loses at most the shards in work.

    Raises:
        FileExistsError: if the folder holds anything but this very dataset, or shards of other settings.
    """
    root = config.output_root
    shards_folder = root.with_name(f"{root.name}.shards")
    if _is_complete(config, root):
        shutil.rmtree(shards_folder, ignore_errors=True)  # left by a run killed at its very end
        print(f"{root} is already complete.")
        return root
    _open_shards_folder(config, shards_folder)
    start = time.monotonic()
    shards = plan_shards(config)
    with quiet():
        write_missing_shards(shards, shards_folder, config.num_workers)
        records = [ShardRecord.load(shards_folder / shard.name) for shard in shards]
        merged = shards_folder / f"{TEMPORARY_PREFIX}merged"
        merge_shards(shards, shards_folder, config.repo_id, merged)
    seconds = time.monotonic() - start
    write_collection_record(merged, config.identity(), records, seconds)
    merged.rename(root)
    shutil.rmtree(shards_folder)
    print_summary(root, records, seconds)
    return root


def _is_complete(config: CollectConfig, root: Path) -> bool:
    if not root.exists():
        return False
    record = root / COLLECTION_RECORD
    if not record.exists():
        raise FileExistsError(
            f"{root} exists and was not made by `lerobot-wm collect`; give another --root or remove it."
        )
    # Datasets made before there was a choice of these do not name theirs.
    earlier = {"variation_set": REPORTED_VARIATION_SET, "camera_name": CAMERA_NAME}
    found = {**earlier, **json.loads(record.read_text())["config"]}
    _refuse_difference(
        found, config.identity(), f"{root} holds a dataset", "give another --root or remove it"
    )
    return True


def _open_shards_folder(config: CollectConfig, folder: Path) -> None:
    expected = {**config.identity(), "versions": versions()}
    settings = folder / "config.json"
    if settings.exists():
        found = json.loads(settings.read_text())
        mend = f"repeat that run's flags, give another --root, or remove {folder}"
        _refuse_difference(found, expected, f"{folder} holds an unfinished collection", mend)
    else:
        folder.mkdir(parents=True, exist_ok=True)
        settings.write_text(json.dumps(expected, indent=2))
    for unfinished in folder.glob(f"{TEMPORARY_PREFIX}*"):
        shutil.rmtree(unfinished)


def _refuse_difference(found: dict[str, Any], expected: dict[str, Any], what: str, mend: str) -> None:
    # Through JSON, so that both sides have its types.
    expected = json.loads(json.dumps(expected))
    different = [
        f"{name} {found.get(name)} there, {value} here"
        for name, value in expected.items()
        if found.get(name) != value
    ]
    if different:
        raise FileExistsError(f"{what} made with other settings ({'; '.join(different)}); {mend}.")


def main() -> None:
    """Entry point of `lerobot-wm collect`."""
    logging.basicConfig(level=logging.WARNING)
    try:
        collect(draccus.parse(CollectConfig, args=sys.argv[1:]))
    except (ValueError, FileExistsError, RuntimeError) as error:
        sys.exit(f"lerobot-wm collect: {error}")


if __name__ == "__main__":
    main()

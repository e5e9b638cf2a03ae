"""`lerobot-wm collect`: demonstrations of Meta-World's scripted experts, collected in shards and merged."""

import json
import logging
import shutil
import time
from collections import Counter, defaultdict
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import draccus
from huggingface_hub.constants import ENDPOINT
from huggingface_hub.utils import validate_repo_id
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import HF_LEROBOT_HOME
from rich import box
from rich.console import Console
from rich.table import Column, Table
from tqdm import tqdm

from lerobot_wm.collect.merge import merge_datasets
from lerobot_wm.collect.shards import SHARD_EPISODES, Shard, ShardRecord, versions, write_shard
from lerobot_wm.constants import CAMERA_NAME, IMAGE_SIZE, REPORTED_VARIATION_SET
from lerobot_wm.data.latents import dataset_fingerprint
from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.envs.cameras import parse_cameras
from lerobot_wm.envs.tasks import expert_name, resolve_tasks, task_description
from lerobot_wm.envs.variations import check_variation_set, parse_variations
from lerobot_wm.errors import cache_folders, check_can_push
from lerobot_wm.files import UNFINISHED, appears_whole, check_writable, sole_writer
from lerobot_wm.markdown import Markdown, render
from lerobot_wm.system import quiet, silence
from lerobot_wm.workers import Job, check_same_settings, map_in_workers, shards_folder

META_WORLD_BIBTEX = """@inproceedings{yu2019meta,
  title={Meta-World: A Benchmark and Evaluation for Multi-Task and Meta Reinforcement Learning},
  author={Yu, Tianhe and Quillen, Deirdre and He, Zhanpeng and Julian, Ryan and Hausman, Karol and Finn, Chelsea
          and Levine, Sergey},
  booktitle={Conference on Robot Learning},
  year={2019}
}"""


@dataclass
class CollectConfig:
    """Collect successful demonstrations of Meta-World's scripted experts into a LeRobotDataset."""

    # Name of the dataset, as user/name.
    repo_id: str
    # Folder of the dataset; by default LeRobot's own place for repo_id.
    root: Path | None = None
    # A task, a set (mt6, mt10, mt50, ml45, ml45_test) or a comma-separated list.
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


def collect(config: CollectConfig) -> Path:
    """Collect a dataset or one job's part of it, or resume an interrupted collection.

    Shards are written beside the dataset in `<root>.shards/`, merged, and removed. A folder with its final name is
    complete, so that a killed run loses at most the shards it was writing. A job with `shard` writes its own shards
    and merges nothing.

    Returns:
        The folder of the dataset, or of the shards for a job.

    Raises:
        FileExistsError: The folder has anything but this very dataset, or shards with other settings.
        BlockingIOError: Another process is collecting this dataset, or this job's part of it.
        ValueError: A flag names nothing that exists, or a shard is incomplete.
    """
    job = Job.parse(config.shard) if config.shard else None
    with sole_writer(config.output_root, job.lock_name if job else None):
        return _collect(config, job)


def _collect(config: CollectConfig, job: Job | None) -> Path:
    root = config.output_root
    folder = shards_folder(root)
    if _is_complete(config, root):
        # A run that was killed at its very end may have left the shards.
        shutil.rmtree(folder, ignore_errors=True)
        print(f"{root} is already complete.")
        return root
    # Merging reads the shards through this cache.
    check_writable(cache_folders()["HF_DATASETS_CACHE"])
    shards = plan_shards(config)
    mine = job.select(shards) if job else shards
    folder.mkdir(parents=True, exist_ok=True)
    if finished := _count_finished(shards, folder):
        print(f"{finished} of {len(shards)} shards are already in {folder}.")
    start = time.monotonic()
    with quiet():
        write_missing_shards(mine, folder, config.num_workers)
    if job:
        print(
            f"Job {config.shard} is done: {_count_finished(shards, folder)} of {len(shards)} shards are in {folder}. "
            "When all are there, the same command without --shard merges them."
        )
        return folder
    records = [ShardRecord.load(folder / shard.name) for shard in shards]
    print(f"Merging {len(shards)} shards")
    with appears_whole(root) as temporary:
        with quiet():
            merge_datasets([folder / shard.name for shard in shards], config.repo_id, temporary)
        seconds = time.monotonic() - start
        _write_record(temporary, config, records, seconds)
    shutil.rmtree(folder)
    _print_summary(root, records, seconds)
    return root


def plan_shards(config: CollectConfig) -> list[Shard]:
    """The shards of a collection in the order of the final dataset: by task, then by episode.

    Raises:
        ValueError: There is no such task, variation or camera.
    """
    tasks, variations = resolve_tasks(config.tasks), parse_variations(config.variations)
    check_variation_set(config.variation_set)
    if config.episodes_per_task < 1:
        raise ValueError(f"--episodes_per_task={config.episodes_per_task}: expected at least 1.")
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


def _is_complete(config: CollectConfig, root: Path) -> bool:
    if not root.exists():
        return False
    record = root / COLLECTION_RECORD
    if not record.exists():
        raise FileExistsError(
            f"{root} exists and was not made by `lerobot-wm collect`: give another --root or remove it."
        )
    found = json.loads(record.read_text())["config"]
    check_same_settings(found, config.identity(), f"{root} is a dataset", "give another --root or remove it")
    return True


def _count_finished(shards: list[Shard], folder: Path) -> int:
    """Count the finished shards in a folder; other shards there are an error, as are incomplete ones."""
    planned = {shard.name: shard for shard in shards}
    fix = "use the same flags again, give another --root, or remove it"
    found = [path for path in sorted(folder.iterdir()) if path.suffix != UNFINISHED]
    for path in found:
        if path.name not in planned:
            raise FileExistsError(
                f"{path} is a shard of another collection, with other --tasks or more episodes: {fix}."
            )
        made_of = ShardRecord.load(path).made_of
        check_same_settings(made_of, planned[path.name].made_of(), f"{path} is a shard", fix)
    return len(found)


def write_missing_shards(shards: list[Shard], folder: Path, num_workers: int) -> None:
    """Write the shards that are not in `folder` yet, with a progress bar over all episodes."""
    missing = [shard for shard in shards if not (folder / shard.name).exists()]
    total = sum(shard.count for shard in shards)
    done = total - sum(shard.count for shard in missing)
    with tqdm(total=total, initial=done, unit="episode", desc="collecting") as bar:
        for count in map_in_workers(partial(write_shard, folder=folder), missing, num_workers, silence):
            bar.update(count)


def _write_record(root: Path, config: CollectConfig, records: list[ShardRecord], seconds: float) -> None:
    """Write how the dataset was collected into its meta folder; episodes are in the dataset's order."""
    episodes = [asdict(episode) for record in records for episode in record.episodes]
    for index, episode in enumerate(episodes):
        episode["episode_index"] = index
    failures: dict[str, Counter[int]] = defaultdict(Counter)
    for record in records:
        failures[record.episodes[0].task].update(record.failures)
    identity = config.identity()
    content = {
        "config": identity,
        "versions": versions(),
        "experts": {task: expert_name(task) for task in identity["tasks"]},
        "failed_attempts": {
            task: dict(sorted(counts.items())) for task, counts in failures.items() if counts
        },
        "seconds": round(seconds, 1),
        "episodes": episodes,
    }
    (root / COLLECTION_RECORD).write_text(json.dumps(content, indent=1))


def _print_summary(root: Path, records: list[ShardRecord], seconds: float) -> None:
    """Print a table with a row per task.

    steps: mean length; failed: attempts without success; retried: episodes that needed more than one attempt; moved:
    episodes collected on another variation than planned; seconds: sum over all workers.
    """
    by_task: dict[str, list[ShardRecord]] = defaultdict(list)
    for record in records:
        by_task[record.episodes[0].task].append(record)
    columns = [
        Column(name, justify="right", no_wrap=True)
        for name in ("episodes", "steps", "failed", "retried", "moved", "seconds")
    ]
    table = Table(Column("task", no_wrap=True), *columns, title=f"{root} in {seconds:.0f} s", box=box.SIMPLE)
    for task, of_task in by_task.items():
        episodes = [episode for record in of_task for episode in record.episodes]
        cells = (
            len(episodes),
            f"{sum(episode.length for episode in episodes) / len(episodes):.1f}",
            sum(sum(record.failures.values()) for record in of_task),
            sum(episode.attempt > 0 or episode.moved for episode in episodes),
            sum(episode.moved for episode in episodes),
            f"{sum(record.seconds for record in of_task):.0f}",
        )
        table.add_row(task, *map(str, cells))
    Console().print(table)


def push(config: CollectConfig) -> None:
    """Upload the complete dataset, with a card that says how it was collected."""
    record = json.loads((config.output_root / COLLECTION_RECORD).read_text())
    dataset = LeRobotDataset(config.repo_id, root=config.output_root)
    push_demonstrations(dataset, {**record, "config": config.identity()}, config.private, config.license)


def push_demonstrations(dataset: LeRobotDataset, record: dict[str, Any], private: bool, license: str) -> None:
    """Push a dataset of `lerobot-wm collect` and its card.

    Args:
        dataset: The dataset.
        record: The content of its `meta/collection.json`.
        private: Whether a new repository is private.
        license: The dataset's licence, as the Hub names it.
    """
    episodes = record["episodes"]
    tasks = [
        _task_row(task, [e for e in episodes if e["task"] == task], record)
        for task in record["config"]["tasks"]
    ]
    description = render(
        Path(__file__).with_name("demonstrations.md.j2"),
        repo_id=dataset.repo_id,
        config=record["config"],
        versions=record["versions"],
        tasks=tasks,
        n_episodes=dataset.num_episodes,
        n_frames=dataset.num_frames,
        fps=dataset.fps,
        fingerprint=dataset_fingerprint(Path(dataset.root)),
        command=Markdown(_collect_command(record["config"], dataset.repo_id)),
    )
    # LeRobot sets the version tag last, and reads nothing without it: readers see the dataset once it is complete.
    dataset.push_to_hub(
        tags=["lerobot_wm", "metaworld", "demonstrations"],
        license=license,
        private=private,
        dataset_description=description,
        url="https://meta-world.github.io",
        paper="Meta-World, https://arxiv.org/abs/1910.10897",
        citation_bibtex=META_WORLD_BIBTEX,
    )
    print(f"Dataset pushed to {ENDPOINT}/datasets/{dataset.repo_id}")


def _task_row(task: str, episodes: list[dict[str, Any]], record: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": task,
        "string": task_description(task),
        "episodes": len(episodes),
        "steps": sum(e["length"] for e in episodes) / len(episodes),
        "variations": _ranges(sorted({e["variation"] for e in episodes})),
        "failed": sum(record["failed_attempts"].get(task, {}).values()),
        "moved": sum(e["moved"] for e in episodes),
        "expert": record["experts"][task],
    }


def _ranges(numbers: list[int]) -> str:
    """Write 0, 1, 2, 5 as "0-2, 5"."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _collect_command(config: dict[str, Any], repo_id: str) -> str:
    """The command that collects the same demonstrations again."""
    values = {**config, "tasks": ",".join(config["tasks"])}
    values["variations"] = _ranges(config["variations"]).replace(" ", "")
    return " ".join(
        ["lerobot-wm collect", *(f"--{key}={value}" for key, value in values.items()), f"--repo_id={repo_id}"]
    )


def main() -> None:
    """Entry point of `lerobot-wm collect`."""
    logging.basicConfig(level=logging.WARNING)
    config = draccus.parse(CollectConfig)
    if config.push_to_hub:
        check_can_push(config.repo_id)
    collect(config)
    if config.push_to_hub and config.shard is None:
        push(config)


if __name__ == "__main__":
    main()

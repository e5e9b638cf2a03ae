"""Shards of a collection: a few episodes of a task in a LeRobotDataset of their own, with a record in `shard.json`."""

import json
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs.video import RGBEncoderConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.collect.episode import Demonstration, dataset_frames, demonstrate
from lerobot_wm.constants import (
    ACTION,
    DENSE_REWARD,
    FPS,
    MAX_EPISODE_STEPS,
    OBS_ENV_STATE,
    OBS_STATE,
    REWARD,
    ROBOT_TYPE,
)
from lerobot_wm.data.schema import metaworld_features
from lerobot_wm.envs.cameras import image_features
from lerobot_wm.envs.rendering import Renderer, RenderKey
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.envs.tasks import task_id
from lerobot_wm.files import appears_whole

SHARD_RECORD = "shard.json"
# About ten seconds of work, which is what a killed worker has to repeat.
SHARD_EPISODES = 13
_NUMBERS = (OBS_STATE, OBS_ENV_STATE, ACTION, REWARD, DENSE_REWARD)


@dataclass
class EpisodeRecord:
    """How an episode was collected.

    Attributes:
        task: Its task.
        episode: Its number within the task.
        variation: The variation it was collected on.
        moved: Whether the expert failed on the planned variation, so that this is another one.
        attempt: Number of failures on this variation before it.
        seed: Entropy of the noise's np.random.SeedSequence.
        length: Number of frames.
    """

    task: str
    episode: int
    variation: int
    moved: bool
    attempt: int
    seed: list[int]
    length: int


@dataclass
class ShardRecord:
    """The record of a finished shard.

    Attributes:
        made_of: What its content depends on, see `Shard.made_of`.
        episodes: How each episode was collected.
        failures: Number of failed attempts by variation.
        seconds: Wall time.
        files: Size in bytes of each other file of the shard, by path.
    """

    made_of: dict[str, Any]
    episodes: list[EpisodeRecord]
    failures: dict[int, int]
    seconds: float
    files: dict[str, int]

    @classmethod
    def load(cls, folder: Path) -> "ShardRecord":
        """Read the record of a finished shard.

        Raises:
            ValueError: The record, or a file that it names, is missing or incomplete.
        """
        path = folder / SHARD_RECORD
        data = json.loads(path.read_text()) if path.exists() else {}
        if "files" not in data or not data["files"].items() <= file_sizes(folder).items():
            raise ValueError(
                f"{folder} is an incomplete shard: copy it again, or remove it to have it collected again."
            )
        return cls(
            made_of=data["made_of"],
            episodes=[EpisodeRecord(**episode) for episode in data["episodes"]],
            failures={int(variation): count for variation, count in data["failures"].items()},
            seconds=data["seconds"],
            files=data["files"],
        )


def file_sizes(folder: Path) -> dict[str, int]:
    """Size in bytes of each file of a shard except its record, by path."""
    return {
        path.relative_to(folder).as_posix(): path.stat().st_size
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != SHARD_RECORD
    }


@dataclass(frozen=True)
class Shard:
    """Episodes `first` to `first + count - 1` of a task, and all settings that they depend on."""

    task: str
    first: int
    count: int
    variation_set: int
    variations: tuple[int, ...]
    noise: float
    steps_after_success: int
    max_attempts: int
    seed: int
    image_size: int
    cameras: tuple[str, ...]

    @property
    def name(self) -> str:
        """Folder name."""
        return f"{self.task}-{self.first:05d}"

    def made_of(self) -> dict[str, Any]:
        """All that its content depends on, including versions of packages."""
        return {**asdict(self), "versions": versions()}


def versions() -> dict[str, str]:
    """Versions of packages that trajectories depend on; they differ in the fourth decimal between mujoco versions."""
    return {name: version(name) for name in ("mujoco", "metaworld", "lerobot", "lerobot_policy_wm")}


def write_shard(shard: Shard, folder: Path) -> int:
    """Collect a shard into `folder / shard.name`; that folder appears only when it is complete.

    Args:
        shard: What to collect.
        folder: Folder of all shards.

    Returns:
        The number of its episodes.

    Raises:
        RuntimeError: The expert failed an episode on every variation, `max_attempts` times each.
        ValueError: An observation, action or reward is not finite.
    """
    with appears_whole(folder / shard.name) as temporary:
        _write_shard(shard, temporary)
    return shard.count


def _write_shard(shard: Shard, root: Path) -> None:
    start = time.monotonic()
    dataset = _create_dataset(root, shard)
    simulation = Simulation(shard.task, shard.variation_set)
    render_keys = {
        feature: RenderKey(shard.task, camera, shard.image_size, fast=True)
        for camera, feature in image_features(shard.cameras).items()
    }
    renderers = {feature: Renderer.acquire(key, simulation.model) for feature, key in render_keys.items()}
    record = ShardRecord(made_of=shard.made_of(), episodes=[], failures={}, seconds=0.0, files={})
    for episode in range(shard.first, shard.first + shard.count):
        demonstration = _succeed(shard, episode, simulation, record)
        frames = dataset_frames(demonstration, simulation, renderers)
        _check_finite(frames, f"{shard.task}, episode {episode}, variation {demonstration.variation}")
        for frame in frames:
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()
    for key in render_keys.values():
        Renderer.release(key)
    record.seconds = time.monotonic() - start
    record.files = file_sizes(root)
    (root / SHARD_RECORD).write_text(json.dumps(asdict(record)))


def _check_finite(frames: list[dict[str, Any]], name: str) -> None:
    """LeRobot would write NaN silently."""
    for t, frame in enumerate(frames):
        for key in _NUMBERS:
            if not np.isfinite(frame[key]).all():
                raise ValueError(f"{name}, frame {t}: {key} is not finite. The episode was not saved.")


def _succeed(shard: Shard, episode: int, simulation: Simulation, record: ShardRecord) -> Demonstration:
    """Try the planned variation up to `max_attempts` times, then the next one, and so on; add to the record."""
    n = len(shard.variations)
    order = [shard.variations[(episode + offset) % n] for offset in range(n)]
    for variation in order:
        for attempt in range(shard.max_attempts):
            seed = [shard.seed, task_id(shard.task), variation, episode, attempt]
            rng = np.random.default_rng(np.random.SeedSequence(seed))
            demonstration = demonstrate(simulation, variation, shard.noise, shard.steps_after_success, rng)
            if demonstration is not None:
                record.episodes.append(
                    EpisodeRecord(
                        task=shard.task,
                        episode=episode,
                        variation=variation,
                        moved=variation != order[0],
                        attempt=attempt,
                        seed=seed,
                        length=len(demonstration.actions),
                    )
                )
                return demonstration
            record.failures[variation] = record.failures.get(variation, 0) + 1
    raise RuntimeError(
        f"{shard.task}, episode {episode}: the scripted expert failed {shard.max_attempts} attempts on each of the "
        f"variations {order} with noise {shard.noise}. Lower --noise, raise --max_attempts or add variations."
    )


def _create_dataset(root: Path, shard: Shard) -> LeRobotDataset:
    return LeRobotDataset.create(
        repo_id=f"shards/{shard.name}",
        root=root,
        fps=FPS,
        robot_type=ROBOT_TYPE,
        features=metaworld_features(shard.image_size, image_features(shard.cameras).values()),
        # Full chroma resolution, because yuv420p loses the 3-pixel red dot that marks the goal of reach-v3.
        # No mbtree, because with it x264 sometimes encodes the same frames differently (25 of 600 shards of two
        # episodes on a busy machine; 0 of 400 without it).
        rgb_encoder=RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=10, extra_options={"mbtree": 0}),
        streaming_encoding=True,
        # A full queue would drop frames.
        encoder_queue_maxsize=MAX_EPISODE_STEPS,
        encoder_threads=1,
    )

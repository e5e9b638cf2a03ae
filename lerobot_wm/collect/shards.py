"""What a finished shard says of itself, in its `shard.json`."""

import json
import os
import time
from collections.abc import Callable
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
from lerobot_wm.data.schema import check_finite, metaworld_features
from lerobot_wm.envs.cameras import image_features
from lerobot_wm.envs.rendering import Renderer, RenderKey
from lerobot_wm.envs.simulation import Simulation
from lerobot_wm.envs.tasks import task_id

SHARD_RECORD = "shard.json"


@dataclass
class EpisodeRecord:
    """How an episode came about.

    Args:
        task: its task.
        episode: its number within the task.
        variation: the one it was collected on.
        moved: whether that is another than planned, the expert having failed there.
        attempt: failures on this variation before it.
        seed: entropy of the noise's np.random.SeedSequence.
        length: frames.
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
    """A finished shard.

    Args:
        made_of: what its content depends on, as `Shard.made_of` says it.
        episodes: how each came about.
        failures: failed attempts by variation.
        seconds: wall time.
        files: bytes of each of its other files, by path.
    """

    made_of: dict[str, Any]
    episodes: list[EpisodeRecord]
    failures: dict[int, int]
    seconds: float
    files: dict[str, int]

    @classmethod
    def load(cls, folder: Path) -> "ShardRecord":
        """Read the record that lies in a finished shard.

        Raises:
            ValueError: it is missing, or a file it names is missing or cut short.
        """
        path = folder / SHARD_RECORD
        data = json.loads(path.read_text()) if path.exists() else {}
        if "files" not in data or not data["files"].items() <= file_sizes(folder).items():
            raise ValueError(
                f"{folder} is not a whole shard: copy it again, or remove it and it is collected."
            )
        return cls(
            made_of=data["made_of"],
            episodes=[EpisodeRecord(**episode) for episode in data["episodes"]],
            failures={int(variation): count for variation, count in data["failures"].items()},
            seconds=data["seconds"],
            files=data["files"],
        )


def file_sizes(folder: Path) -> dict[str, int]:
    """Bytes of each file of a shard but its record, by path."""
    return {
        path.relative_to(folder).as_posix(): path.stat().st_size
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != SHARD_RECORD
    }


SHARD_EPISODES = 13  # some ten seconds of work: what a killed worker has to redo
TEMPORARY_PREFIX = "unfinished-"
_FINITE = (OBS_STATE, OBS_ENV_STATE, ACTION, REWARD, DENSE_REWARD)


@dataclass(frozen=True)
class Shard:
    """Episodes `first` to `first + count - 1` of a task, and all that making them depends on."""

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
        """All that its content depends on, the versions of packages too."""
        return {**asdict(self), "versions": versions()}


def versions() -> dict[str, str]:
    """Versions of what a trajectory depends on; mujoco's change its fourth decimal."""
    return {name: version(name) for name in ("mujoco", "metaworld", "lerobot", "lerobot_policy_wm")}


def write_shard(shard: Shard, folder: Path, on_episode: Callable[[], None]) -> None:
    """Collect a shard into `folder / shard.name`; the folder appears only when it is complete.

    Args:
        shard: what to collect.
        folder: where shards lie.
        on_episode: called after each finished episode.

    Raises:
        RuntimeError: if the expert fails an episode on every variation, `max_attempts` times each.
        ValueError: if an observation, action or reward is not finite.
    """
    start = time.monotonic()
    temporary = folder / f"{TEMPORARY_PREFIX}{shard.name}-{os.getpid()}"
    dataset = _create_dataset(temporary, shard)
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
        numbers = {key: np.stack([frame[key] for frame in frames]) for key in _FINITE}  # (T, ...) each
        check_finite(numbers, where=f"{shard.task}, episode {episode}, variation {demonstration.variation}")
        for frame in frames:
            dataset.add_frame(frame)
        dataset.save_episode()
        on_episode()
    dataset.finalize()
    for key in render_keys.values():
        Renderer.release(key)
    record.seconds = time.monotonic() - start
    record.files = file_sizes(temporary)
    (temporary / SHARD_RECORD).write_text(json.dumps(asdict(record)))
    temporary.rename(folder / shard.name)


def _succeed(shard: Shard, episode: int, simulation: Simulation, record: ShardRecord) -> Demonstration:
    """Try the episode's variation until it succeeds, then the next one, and so on; note what happened."""
    n = len(shard.variations)
    order = [shard.variations[(episode + offset) % n] for offset in range(n)]
    for variation in order:
        for attempt in range(shard.max_attempts):
            seed = [shard.seed, task_id(shard.task), variation, episode, attempt]
            rng = np.random.default_rng(np.random.SeedSequence(seed))
            demonstration = demonstrate(simulation, variation, shard.noise, shard.steps_after_success, rng)
            if demonstration is not None:
                length = len(demonstration.actions)
                moved = variation != order[0]
                record.episodes.append(
                    EpisodeRecord(shard.task, episode, variation, moved, attempt, seed, length)
                )
                return demonstration
            record.failures[variation] = record.failures.get(variation, 0) + 1
    raise RuntimeError(
        f"{shard.task}, episode {episode}: the scripted expert failed {shard.max_attempts} attempts on each of "
        f"the variations {order} at noise {shard.noise}. Lower --noise, raise --max_attempts or add variations."
    )


def _create_dataset(root: Path, shard: Shard) -> LeRobotDataset:
    return LeRobotDataset.create(
        repo_id=f"shards/{shard.name}",
        root=root,
        fps=FPS,
        robot_type=ROBOT_TYPE,
        features=metaworld_features(shard.image_size, image_features(shard.cameras).values()),
        # Full chroma resolution: with yuv420p the 3-pixel red dot that marks reach-v3's goal is lost.
        # Without mbtree: with it x264, given the same frames, now and then writes other ones (25 of 600 shards of two
        # episodes on a busy machine; none of 400 without).
        rgb_encoder=RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=10, extra_options={"mbtree": 0}),
        streaming_encoding=True,
        encoder_queue_maxsize=MAX_EPISODE_STEPS,  # a full queue drops frames
        encoder_threads=1,
    )

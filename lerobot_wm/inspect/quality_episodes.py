"""Demonstrations in memory, and what the world model's filter makes of them."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import pandas as pd
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tqdm import trange

from lerobot_wm.constants import ACTION, ENV_STATE_DIM, OBS_ENV_STATE, REWARD, SUCCESS, VARIATION
from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.data.tables import column_tensor
from lerobot_wm.nn.conv import IMAGE_SIZE
from lerobot_wm.nn.images import stack_images
from lerobot_wm.policies.common.features import join_vectors
from lerobot_wm.world_model.model import WorldModel
from lerobot_wm.world_model.rssm import RSSMState

# Meta-World's 39-dimensional state (m): hand and first object at its start, the goal at its end.
POSITIONS = {"object": slice(4, 7), "gripper": slice(0, 3), "goal": slice(36, 39)}
_EPISODES_PER_BATCH = 16


@dataclass(frozen=True)
class Episode:
    """One demonstration of T frames; what arrives with o_{t+1} is stored at frame t.

    Attributes:
        task: The task.
        variation: Which of its fixed variations, in Meta-World; elsewhere the episode's index.
        frames: Each camera's frames, (T, 64, 64, C) uint8, views of the memory-mapped cache.
        actions: (T, A).
        proprio: What the world model reads beside images, (T, P); None if nothing.
        targets: What probes read from the latent, (T, ·) by name: Meta-World's positions (m), elsewhere the vectors of
            the observation.
        success: (T,) bool: `next.success`, or where the reward is 0 or 1 whether it is 1; None without.
    """

    task: str
    variation: int
    frames: list[Tensor]
    actions: Tensor
    proprio: Tensor | None
    targets: dict[str, Tensor]
    success: Tensor | None

    def images(self, steps: slice | list[int]) -> Tensor:
        """The images of these steps as the world model sees them, (N, C, 64, 64) in [0, 1]."""
        images = [frames[steps].movedim(-1, -3).float() / 255 for frames in self.frames]  # (N, C, H, W) each
        return stack_images(images, (IMAGE_SIZE, IMAGE_SIZE))


@dataclass(frozen=True)
class Filtered:
    """The closed loop over one episode of T frames: the filter sees every image; z_t is the posterior mean.

    Attributes:
        states: (T, ·).
        embeds: (T, E).
        kl: KL(posterior || prior) in nats, (T,).
    """

    states: RSSMState
    embeds: Tensor
    kl: Tensor

    @property
    def latents(self) -> Tensor:
        """s_t, (T, D+S)."""
        return self.states.latent


def choose_episodes(episodes: pd.DataFrame, per_task: int, seed: int) -> list[int]:
    """Choose up to `per_task` episodes of each task, spread evenly over its variations.

    Args:
        episodes: One row per episode: `episode_index`, `task_index`, `variation`.
        per_task: Episodes of each task.
        seed: Seed of the choice.

    Returns:
        Sorted episode indices.
    """
    shuffled = episodes.sample(frac=1, random_state=seed)
    turn = shuffled.groupby(["task_index", "variation"]).cumcount()
    by_turn = shuffled.iloc[turn.argsort(kind="stable")]
    return sorted(by_turn.groupby("task_index").head(per_task)["episode_index"].tolist())


def read_demonstrations(
    source: SourceConfig,
    cameras: list[str],
    per_task: int,
    seed: int,
    of_tasks: Collection[str] | None = None,
    *,
    proprio: Sequence[str] = (),
    reward_key: str = REWARD,
) -> list[Episode]:
    """Read some episodes of a dataset; no others are decoded.

    Args:
        source: The dataset.
        cameras: Whose frames to read.
        per_task: Episodes of each task.
        seed: Seed of the choice, see `choose_episodes`.
        of_tasks: The tasks; None for all.
        proprio: Vectors that the world model reads beside images.
        reward_key: The reward, where there is no `next.success`.

    Raises:
        DatasetError: The dataset is damaged.
    """
    meta = source.metadata()
    dataset = LeRobotDataset(source.repo_id, root=source.root, revision=source.revision)
    # Where it is not known which episodes begin alike, each counts as a variation of its own.
    variation = VARIATION if has_positions(meta) else "episode_index"
    table = pd.DataFrame(
        {
            name: column_tensor(dataset.hf_dataset, key, (1,)).numpy()
            for name, key in (
                ("episode_index", "episode_index"),
                ("task_index", "task_index"),
                (VARIATION, variation),
            )
        }
    )
    tasks = [str(task) for task in dataset.meta.tasks.index]
    if of_tasks is not None:
        table = table[table["task_index"].isin([i for i, task in enumerate(tasks) if task in of_tasks])]
    chosen = choose_episodes(table.drop_duplicates("episode_index"), per_task, seed)
    dataset = LeRobotDataset(source.repo_id, root=source.root, revision=source.revision, episodes=chosen)
    # Each camera's (N, 64, 64, C), by absolute index.
    of_cameras = [camera_frames(dataset, key, (IMAGE_SIZE, IMAGE_SIZE)) for key in cameras]
    columns = {
        key: column_tensor(dataset.hf_dataset, key, tuple(feature["shape"]))
        for key, feature in meta.features.items()
        if key not in meta.camera_keys and feature["dtype"].startswith(("float", "int", "bool"))
    }
    # LeRobot drops the axis of vectors of one number.
    vectors = {
        key: values.view(len(values), -1)
        for key, values in columns.items()
        if key == ACTION or key.startswith("observation.")
    }
    joined = join_vectors(vectors, proprio)
    _, lengths = torch.unique_consecutive(columns["episode_index"], return_counts=True)

    def split(values: Tensor) -> tuple[Tensor, ...]:
        return values.split(lengths.tolist())

    per_episode = {key: split(columns[key]) for key in ("index", "task_index", variation)}
    actions = split(vectors.pop(ACTION))
    if has_positions(meta):
        vectors = {name: vectors[OBS_ENV_STATE][:, place] for name, place in POSITIONS.items()}
    targets = {name: split(values) for name, values in vectors.items()}
    success = _success(columns, reward_key)
    return [
        Episode(
            task=tasks[int(per_episode["task_index"][i][0])],
            variation=int(per_episode[variation][i][0]),
            frames=[frames[int(index[0]) : int(index[-1]) + 1] for frames in of_cameras],
            actions=actions[i],
            proprio=None if joined is None else split(joined)[i],
            targets={name: values[i] for name, values in targets.items()},
            success=None if success is None else split(success)[i],
        )
        for i, index in enumerate(per_episode["index"])
    ]


def has_positions(meta: LeRobotDatasetMetadata) -> bool:
    """Whether a dataset is of `lerobot-wm collect`: with positions of objects, and fixed variations of them."""
    shape = meta.features.get(OBS_ENV_STATE, {"shape": ()})["shape"]
    return tuple(shape) == (ENV_STATE_DIM,) and VARIATION in meta.features


def _success(columns: Mapping[str, Tensor], reward_key: str) -> Tensor | None:
    """Whether each step (N,) succeeded; None where the dataset does not say."""
    values = columns.get(SUCCESS, columns.get(reward_key))
    if values is None or not ((values == 0) | (values == 1)).all():
        return None
    return values.bool()


@torch.no_grad()
def filter_episodes(world_model: WorldModel, episodes: list[Episode]) -> list[Filtered]:
    """Filter every episode from its first frame on; results are on the CPU."""
    device = world_model.action_scaling.offset.device
    results = []
    for begin in trange(0, len(episodes), _EPISODES_PER_BATCH, desc="Filtering", unit="batch"):
        batch = episodes[begin : begin + _EPISODES_PER_BATCH]
        # The filter is causal, so padding after a shorter episode's last frame does not change its states.
        embeds = pad_sequence([_embed(world_model, episode, device) for episode in batch], batch_first=True)
        actions = pad_sequence([episode.actions for episode in batch], batch_first=True)  # (B, T, A)
        states, kl = world_model.filter_with_kl(embeds, actions.to(device))  # (B, T, ·), (B, T)
        for i, episode in enumerate(batch):
            steps = len(episode.actions)
            of_episode = RSSMState(states.deter[i, :steps].cpu(), states.stoch[i, :steps].cpu())
            results.append(Filtered(of_episode, embeds[i, :steps].cpu(), kl[i, :steps].cpu()))
    return results


def _embed(world_model: WorldModel, episode: Episode, device: torch.device) -> Tensor:
    """e_t of one episode, (T, E)."""
    images = episode.images(slice(None)).to(device)
    proprio = None if episode.proprio is None else episode.proprio[None].to(device)
    return world_model.embed(images[None], proprio)[0]


def start_positions(episodes: list[Episode]) -> list[tuple[str, ...]]:
    """Task, object and goal at each episode's first frame: equal to the bit for equal variations."""
    return [
        (episode.task, *(str(x) for name in ("object", "goal") for x in episode.targets[name][0].tolist()))
        for episode in episodes
    ]

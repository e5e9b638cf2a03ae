"""Demonstrations in memory, and what the world model's filter makes of them."""

from collections.abc import Collection
from dataclasses import dataclass

import pandas as pd
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tqdm import trange

from lerobot_wm.constants import ACTION, OBS_ENV_STATE, OBS_STATE, SUCCESS, VARIATION
from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.options import SourceConfig
from lerobot_wm.data.tables import column_tensor
from lerobot_wm.nn.conv import IMAGE_SIZE
from lerobot_wm.nn.images import stack_images
from lerobot_wm.world_model.model import WorldModel
from lerobot_wm.world_model.rssm import RSSMState

NEEDED = (ACTION, OBS_STATE, OBS_ENV_STATE, SUCCESS, VARIATION)
# First object and goal in Meta-World's 39-dimensional state.
_POSITIONS = [4, 5, 6, 36, 37, 38]
_EPISODES_PER_BATCH = 16


@dataclass(frozen=True)
class Episode:
    """One demonstration of T frames; what arrives with o_{t+1} is stored at frame t.

    Attributes:
        task: The task.
        variation: Which of its fixed variations.
        frames: Each camera's frames, (T, 64, 64, C) uint8, views of the memory-mapped cache.
        actions: (T, A).
        proprio: (T, P).
        env_state: (T, 39).
        success: (T,) bool.
    """

    task: str
    variation: int
    frames: list[Tensor]
    actions: Tensor
    proprio: Tensor
    env_state: Tensor
    success: Tensor

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
) -> list[Episode]:
    """Read some episodes of a Meta-World dataset; no others are decoded.

    Args:
        source: The dataset.
        cameras: Whose frames to read.
        per_task: Episodes of each task.
        seed: Seed of the choice, see `choose_episodes`.
        of_tasks: The tasks; None for all.

    Raises:
        DatasetError: The dataset is damaged.
        ValueError: The dataset lacks a feature, such as the objects' positions.
    """
    meta = source.metadata()
    missing = [key for key in (*cameras, *NEEDED) if key not in meta.features]
    if missing:
        raise ValueError(
            f"{source.repo_id} has no {', '.join(missing)}, which `lerobot-wm quality` needs. Give a dataset of "
            "`lerobot-wm collect`."
        )
    dataset = LeRobotDataset(source.repo_id, root=source.root, revision=source.revision)
    table = pd.DataFrame(
        {
            key: column_tensor(dataset.hf_dataset, key, (1,)).numpy()
            for key in ("episode_index", "task_index", VARIATION)
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
        key: column_tensor(dataset.hf_dataset, key, tuple(dataset.meta.features[key]["shape"]))
        for key in (*NEEDED, "episode_index", "index", "task_index")
    }
    _, lengths = torch.unique_consecutive(columns["episode_index"], return_counts=True)
    per_episode = {key: column.split(lengths.tolist()) for key, column in columns.items()}
    return [
        Episode(
            task=tasks[int(per_episode["task_index"][i][0])],
            variation=int(per_episode[VARIATION][i][0]),
            frames=[frames[int(index[0]) : int(index[-1]) + 1] for frames in of_cameras],
            actions=per_episode[ACTION][i],
            proprio=per_episode[OBS_STATE][i],
            env_state=per_episode[OBS_ENV_STATE][i],
            success=per_episode[SUCCESS][i],
        )
        for i, index in enumerate(per_episode["index"])
    ]


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
    return world_model.embed(images[None], episode.proprio[None].to(device))[0]


def start_positions(episodes: list[Episode]) -> list[tuple[str, ...]]:
    """Task, object and goal at each episode's first frame: equal to the bit for equal variations."""
    return [(episode.task, *map(str, episode.env_state[0, _POSITIONS].tolist())) for episode in episodes]

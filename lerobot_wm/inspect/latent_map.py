"""A map of the latent space: the states s_t of some episodes, projected to the plane by PCA."""

from dataclasses import dataclass

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from sklearn.decomposition import PCA

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import (
    ImaginingPolicy,
    episodes_by_task,
    filter_episodes,
    load_episodes,
    rssm_of,
)

# Of all tasks together, but at least one of each.
MAX_EPISODES = 48
# Of an episode, from its first on: bounds time and memory for longer ones than Meta-World's.
MAX_FRAMES = 500
# Drawn, spread evenly over the frames read.
FRAMES_PER_EPISODE = 40


@dataclass(frozen=True)
class LatentMap:
    """N latents of some episodes, in random order.

    Attributes:
        tasks: The tasks' names.
        n_episodes: How many episodes they are from.
        max_frames: How many frames of each episode were read, at most.
        n_dims: Size of a latent.
        points: Their first two principal components, (N, 2).
        explained: Share of the variance that each of the two explains.
        task: Each latent's position in `tasks`, (N,).
        time: From 0 at an episode's first frame to 1 at the last that was read, (N,).
    """

    tasks: list[str]
    n_episodes: int
    max_frames: int
    n_dims: int
    points: np.ndarray
    explained: np.ndarray
    task: np.ndarray
    time: np.ndarray

    @property
    def legend(self) -> list[tuple[str, str]]:
        """Each task with its colour, as HTML names it."""
        return list(zip(self.tasks, task_colours(len(self.tasks)), strict=True))


def latent_map(policy: ImaginingPolicy, meta: LeRobotDatasetMetadata, source: SourceConfig) -> LatentMap:
    """Filter the last episodes of each task and project their latents, z_t at its posterior mean.

    Args:
        policy: Holds the world model.
        meta: A dataset that it can read, see `check_features`.
        source: Where the dataset is.
    """
    by_task = episodes_by_task(meta)
    per_task = max(1, MAX_EPISODES // len(by_task))
    episodes = sorted(index for of_task in by_task.values() for index in of_task[-per_task:])
    tasks = list(by_task)
    latents, task, time = [], [], []
    read = load_episodes(policy, source, episodes, MAX_FRAMES)
    for episode, loop in zip(read, filter_episodes(rssm_of(policy), read), strict=True):
        of_episode = loop.latents.numpy()  # (T, L)
        last = len(of_episode) - 1
        frames = np.unique(np.linspace(0, last, min(last + 1, FRAMES_PER_EPISODE)).round().astype(int))
        latents.append(of_episode[frames])
        task.append(np.full(len(frames), tasks.index(episode.task)))
        time.append(frames / max(last, 1))
    stacked = np.concatenate(latents)  # (N, L)
    pca = PCA(2, random_state=0)
    points = pca.fit_transform(stacked)
    # In random order, so that no task covers the others.
    order = np.random.default_rng(0).permutation(len(points))
    return LatentMap(
        tasks=tasks,
        n_episodes=len(episodes),
        max_frames=MAX_FRAMES,
        n_dims=stacked.shape[1],
        points=points[order],
        explained=pca.explained_variance_ratio_,
        task=np.concatenate(task)[order],
        time=np.concatenate(time)[order],
    )


def task_colours(n_tasks: int) -> list[str]:
    """Colours that differ as much as possible, as #rrggbb."""
    if n_tasks <= 10:
        return [to_hex(colormaps["tab10"](i)) for i in range(n_tasks)]
    return [to_hex(colormaps["turbo"](i / (n_tasks - 1))) for i in range(n_tasks)]


def latent_figures(latents: LatentMap) -> tuple[Figure, Figure]:
    """The same points coloured by task, and by time within the episode; the page adds the legends."""
    by_task, axes = _axes(latents)
    x, y = latents.points.T
    colours = np.array(task_colours(len(latents.tasks)))
    axes.scatter(x, y, s=7, c=colours[latents.task], linewidths=0, alpha=0.7)
    by_time, axes = _axes(latents)
    axes.scatter(x, y, s=7, c=latents.time, cmap="viridis", linewidths=0, alpha=0.7)
    return by_task, by_time


def _axes(latents: LatentMap) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(5.6, 5), layout="constrained")
    axes = figure.subplots()
    x, y = 100 * latents.explained
    axes.set_xlabel(f"first component ({x:.0f}% of the variance)")
    axes.set_ylabel(f"second component ({y:.0f}%)")
    axes.set_xticks([])
    axes.set_yticks([])
    return figure, axes

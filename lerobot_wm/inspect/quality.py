"""`lerobot-wm quality`: how good a world model is, on episodes that it was never trained on."""

import json
import logging
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path

import draccus
import pandas as pd
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.constants import QUALITY_NAME, VARIATION
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.data.tables import column_tensor
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.episodes import (
    ImaginingPolicy,
    episodes_by_task,
    filter_episodes,
    load_episodes,
    load_world_model,
    rssm_of,
    world_model_config,
)
from lerobot_wm.inspect.open_loop import CONTEXT, HORIZONS, WINDOW
from lerobot_wm.inspect.pictures import PNG, SVG, figure_bytes
from lerobot_wm.inspect.quality_figures import EXAMPLES_NAME, examples_figure, quality_figures
from lerobot_wm.inspect.quality_measures import (
    FOREGROUND_THRESHOLD,
    drift,
    image_errors,
    kl_quality,
    mean_and_median_image,
    predictions,
    reward_quality,
    summarise,
)
from lerobot_wm.inspect.quality_probes import (
    FRAMES_PER_EPISODE,
    POSITIONS,
    draw_frames,
    probe_positions,
    probe_targets,
    probe_task,
    start_positions,
)
from lerobot_wm.nn.images import side_by_side
from lerobot_wm.policies.common.checks import check_reads
from lerobot_wm.records import provenance
from lerobot_wm.world_model.model import WorldModel

logger = logging.getLogger(__name__)

# Training episodes of each task that probes are fitted to, spread over the training data's variations.
PROBE_EPISODES_PER_TASK = 40


@dataclass
class QualityConfig:
    """Flags of `lerobot-wm quality`.

    Args:
        world_model_path: Folder or Hub id of a wm_rssm, wm_bc or wm_iql checkpoint.
        dataset: Episodes to judge it on, that it was not trained on; in Meta-World of other variations.
        output_dir: Where quality.json and the figures are written.
        train_dataset: What it was trained on: probes are fitted to its episodes of the tasks of `dataset`. Without it,
            probes are fitted and tested on `dataset` by cross-validation over variations, or over episodes where the
            dataset has none.
        seed: Seed of every random choice.
        episodes_per_task: Episodes of each task of `dataset`, spread over its variations.
    """

    world_model_path: str
    dataset: SourceConfig
    output_dir: Path
    train_dataset: SourceConfig | None = None
    seed: int = 0
    episodes_per_task: int = 10


def quality(cfg: QualityConfig) -> Path:
    """Judge a world model and write quality.json and figures.

    Returns:
        The path of quality.json.

    Raises:
        ValueError: The checkpoint holds no world model, or a dataset cannot be judged on.
    """
    policy = load_world_model(cfg.world_model_path)
    world_model, cameras = rssm_of(policy), policy.config.cameras
    training, episodes = _read_datasets(cfg, policy)
    knows_positions = set(probe_targets(episodes[0])) == set(POSITIONS)
    config = world_model_config(policy)

    logger.info("Filtering %d episodes", len(training) + len(episodes))
    all_filtered = filter_episodes(world_model, training + episodes)
    filtered = all_filtered[len(training) :]
    # Open loop looks WINDOW frames ahead; the rest takes episodes of any length.
    long = [i for i, episode in enumerate(episodes) if len(episode) >= WINDOW]
    tasks = [episodes[i].task for i in long]
    mean_image, median_image = mean_and_median_image(episodes)
    stacked = predictions(
        world_model, [episodes[i] for i in long], [filtered[i] for i in long], mean_image, cfg.seed
    )
    # Side by side, each camera has its own foreground.
    images = {name: side_by_side(of_name, len(cameras)) for name, of_name in stacked.items()}
    median_image = side_by_side(median_image, len(cameras))

    logger.info("Fitting probes")
    all_untrained = filter_episodes(untrained(world_model, cfg.seed), training + episodes)
    frames = draw_frames(training + episodes, all_filtered, all_untrained, len(training), cfg.seed)
    result = {
        "world_model": cfg.world_model_path,
        "dataset": cfg.dataset.repo_id,
        "train_dataset": cfg.train_dataset and cfg.train_dataset.repo_id,
        "n_episodes": len(episodes),
        "n_episodes_of_seen_positions": _count_seen(training, episodes)
        if training and knows_positions
        else None,
        "settings": {
            "seed": cfg.seed,
            "context": CONTEXT,
            "horizons": HORIZONS,
            "foreground_threshold": FOREGROUND_THRESHOLD,
            "restart": config.window_length,
            "probe_frames_per_episode": FRAMES_PER_EPISODE,
            "rssm": asdict(world_model.config),
        },
        "open_loop": summarise(image_errors(images, tasks, median_image)),
        "reward": reward_quality(world_model, episodes, filtered, config.reward_key)
        if world_model.config.predict_reward
        else None,
        "probes": probe_positions(frames),
        "task_probe": probe_task(frames),
        "kl": kl_quality(episodes, filtered, world_model.config.free_nats),
        "drift": drift(world_model, episodes, filtered, config.window_length),
        "provenance": provenance(),
    }
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    for name, figure in quality_figures(result).items():
        (cfg.output_dir / f"quality_{name}.svg").write_bytes(figure_bytes(figure, SVG))
    (cfg.output_dir / EXAMPLES_NAME).write_bytes(figure_bytes(examples_figure(images, tasks), PNG))
    path = cfg.output_dir / QUALITY_NAME
    path.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    return path


def _read_datasets(cfg: QualityConfig, policy: ImaginingPolicy) -> tuple[list[Episode], list[Episode]]:
    """Episodes of the training data, if it is given, and those to judge on."""
    check_reads(world_model_config(policy), cfg.dataset.metadata())
    training = []
    if cfg.train_dataset is not None:
        tasks = list(episodes_by_task(cfg.dataset.metadata()))
        chosen = choose_episodes(cfg.train_dataset, PROBE_EPISODES_PER_TASK, cfg.seed, tasks)
        if not chosen:
            raise ValueError(
                f"{cfg.train_dataset.repo_id} has no episode of {', '.join(tasks)}: the tasks "
                f"of {cfg.dataset.repo_id}. Give what the world model was trained on, or leave out --train_dataset."
            )
        training = load_episodes(policy, cfg.train_dataset, chosen)
    chosen = choose_episodes(cfg.dataset, cfg.episodes_per_task, cfg.seed)
    episodes = load_episodes(policy, cfg.dataset, chosen)
    n_long = sum(len(episode) >= WINDOW for episode in episodes)
    if n_long < 2:
        raise ValueError(
            f"{n_long} of the {len(episodes)} episodes chosen from {cfg.dataset.repo_id} have {WINDOW} frames or more; "
            "open-loop prediction with shuffled actions needs 2 of them."
        )
    return training, episodes


def choose_episodes(
    source: SourceConfig, per_task: int, seed: int, of_tasks: Collection[str] | None = None
) -> list[int]:
    """Choose up to `per_task` episodes of each task, or of some tasks, spread evenly over its variations.

    Returns:
        Sorted episode indices.
    """
    dataset = LeRobotDataset(source.repo_id, root=source.root, revision=source.revision)
    # Where it is not known which episodes begin alike, each counts as a variation of its own.
    variation = VARIATION if VARIATION in dataset.meta.features else "episode_index"
    keys = {"episode_index": "episode_index", "task_index": "task_index", "variation": variation}
    columns = {name: column_tensor(dataset.hf_dataset, key, (1,)).numpy() for name, key in keys.items()}
    table = pd.DataFrame(columns).drop_duplicates("episode_index")
    if of_tasks is not None:
        names = [str(task) for task in dataset.meta.tasks.index]
        table = table[table["task_index"].isin([i for i, task in enumerate(names) if task in of_tasks])]
    return spread_over_variations(table, per_task, seed)


def spread_over_variations(episodes: pd.DataFrame, per_task: int, seed: int) -> list[int]:
    """Choose rows of a table of `episode_index`, `task_index` and `variation`, see `choose_episodes`."""
    shuffled = episodes.sample(frac=1, random_state=seed)
    turn = shuffled.groupby(["task_index", "variation"]).cumcount()
    by_turn = shuffled.iloc[turn.argsort(kind="stable")]
    return sorted(by_turn.groupby("task_index").head(per_task)["episode_index"].tolist())


def _count_seen(training: list[Episode], episodes: list[Episode]) -> int:
    """Count episodes that start from positions that training episodes start from; warns if there are any."""
    trained_on = {(episode.task, start_positions(episode)) for episode in training}
    n_seen = sum((episode.task, start_positions(episode)) in trained_on for episode in episodes)
    if n_seen:
        logger.warning(
            "%d of %d episodes start from positions of the training data: the results are too good. Collect others.",
            n_seen,
            len(episodes),
        )
    return n_seen


def untrained(world_model: WorldModel, seed: int) -> WorldModel:
    """A world model of the same configuration and input scaling with new random weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fresh = WorldModel(world_model.config)
    scaling = {
        name: value
        for name, value in world_model.state_dict().items()
        if name.split(".")[0].endswith("_scaling")
    }
    fresh.load_state_dict(scaling, strict=False)
    return fresh.eval().to(world_model.action_scaling.offset.device)


def main() -> None:
    """Entry point of `lerobot-wm quality`."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    # It warns about its video decoder once per episode.
    logging.getLogger("lerobot").setLevel(logging.ERROR)
    path = quality(draccus.parse(QualityConfig))
    print(f"World-model quality: {path}")

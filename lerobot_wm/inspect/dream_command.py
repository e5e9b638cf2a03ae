"""`lerobot-wm dream`: what a world model imagines of an episode, as a video and a strip of pictures."""

from dataclasses import dataclass, field
from pathlib import Path

import draccus
from lerobot.configs.default import WandBConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.data.options import SourceConfig
from lerobot_wm.evaluate.wandb_log import log_dream, wandb_run
from lerobot_wm.inspect.dream import Dreams, dream
from lerobot_wm.inspect.dream_figures import strip_figure, write_dream
from lerobot_wm.inspect.episodes import check_features, read_episodes
from lerobot_wm.inspect.html import PNG, figure_bytes
from lerobot_wm.inspect.open_loop import load_world_model
from lerobot_wm.policies.common.checkpoint import split_revision
from lerobot_wm.quiet import quiet, silence


@dataclass
class CheckpointConfig:
    """`--policy.path`, as in `lerobot-eval`."""

    path: str


@dataclass
class DreamConfig:
    """Flags of `lerobot-wm dream`.

    Args:
        policy: Folder or Hub id, with @revision or not, of a wm_rssm, wm_bc or wm_iql checkpoint.
        dataset: The image dataset.
        episode: Which of its episodes.
        context: Frames at its beginning that the world model sees.
        horizon: Steps to imagine; None goes on to the end of the episode.
        output_dir: Where episode_N.mp4 and episode_N.png go.
        wandb: `--wandb.enable=true` logs the dream to the run that trained the checkpoint.
    """

    policy: CheckpointConfig
    dataset: SourceConfig
    episode: int
    context: int = 5
    horizon: int | None = None
    output_dir: Path = Path("outputs/dream")
    wandb: WandBConfig = field(default_factory=WandBConfig)


def dream_of(cfg: DreamConfig) -> Dreams:
    """Dream of an episode and write its video and strip.

    Raises:
        ValueError: The checkpoint holds no world model, the dataset lacks what the policy reads or has it in another
            size, or there is no such episode, or it is too short.
    """
    policy = load_world_model(cfg.policy.path)
    with quiet():
        meta = cfg.dataset.metadata()
        check_features(policy, meta)
        [episode] = read_episodes(policy, meta, cfg.dataset, [cfg.episode], _frames_read(cfg, meta))
    dreams = dream(policy, episode, cfg.context)
    video, strip = outputs(cfg)
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    write_dream(video, dreams, meta.fps)
    strip.write_bytes(figure_bytes(strip_figure(dreams), PNG))
    name, checkpoint_revision = split_revision(cfg.policy.path)
    with wandb_run(cfg.wandb, Path(name), cfg.output_dir, checkpoint_revision) as run:
        if run is not None:
            log_dream(run, dreams, video, strip)
    return dreams


def outputs(cfg: DreamConfig) -> tuple[Path, Path]:
    """The video and the strip to write."""
    return cfg.output_dir / f"episode_{cfg.episode}.mp4", cfg.output_dir / f"episode_{cfg.episode}.png"


def _frames_read(cfg: DreamConfig, meta: LeRobotDatasetMetadata) -> int:
    """How many frames of the episode are seen and imagined."""
    if not 0 <= cfg.episode < meta.total_episodes:
        raise ValueError(
            f"--episode={cfg.episode}, but {meta.repo_id} has {meta.total_episodes} episodes: give one of "
            f"0 to {meta.total_episodes - 1}."
        )
    if cfg.context < 1 or (cfg.horizon is not None and cfg.horizon < 1):
        raise ValueError(
            f"--context={cfg.context}, --horizon={cfg.horizon}: see at least 1 frame and imagine at least 1 step."
        )
    length = meta.episodes[cfg.episode]["length"]
    n_frames = length if cfg.horizon is None else cfg.context + cfg.horizon
    if not cfg.context < n_frames <= length:
        raise ValueError(
            f"Episode {cfg.episode} has {length} frames; to see {cfg.context} and imagine {cfg.horizon or 'the rest'} "
            f"takes at least {max(n_frames, cfg.context + 1)}: lower --context or --horizon, or choose a longer one."
        )
    return n_frames


def main() -> None:
    """Entry point of `lerobot-wm dream`."""
    silence()
    cfg = draccus.parse(DreamConfig)
    dreams = dream_of(cfg)
    video, strip = outputs(cfg)
    print(
        f"{len(dreams.truth) - cfg.context} steps: PSNR {dreams.psnr():.1f} dB under true actions, "
        f"{dreams.copy_psnr():.1f} dB for the last frame copied -> {video}, {strip}"
    )

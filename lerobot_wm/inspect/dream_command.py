"""`lerobot-wm dream`: what a world model imagines of an episode, as a video and a strip of pictures."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import draccus
from lerobot.configs.default import WandBConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.evaluate.wandb_log import wandb_run
from lerobot_wm.inspect.dream import Dreams, actions_are_targets, dream, strip_figure, write_dream
from lerobot_wm.inspect.episodes import (
    CheckpointConfig,
    check_episodes,
    check_features,
    load_episodes,
    load_world_model,
)
from lerobot_wm.inspect.open_loop import CONTEXT
from lerobot_wm.inspect.pictures import PNG, figure_bytes
from lerobot_wm.policies.common.checkpoint import split_revision
from lerobot_wm.system import quiet, silence

if TYPE_CHECKING:  # wandb takes seconds to import
    import wandb


@dataclass
class DreamConfig:
    """Flags of `lerobot-wm dream`.

    Args:
        policy: Folder or Hub id (with @revision or without) of a wm_rssm, wm_bc or wm_iql checkpoint.
        dataset: The image dataset.
        episode: Index of the episode.
        context: How many of its first frames the world model sees.
        horizon: How many steps it imagines; None imagines the rest of the episode.
        output_dir: Where episode_N.mp4 and episode_N.png are written.
        wandb: `--wandb.enable=true` logs the dream to the run that trained the checkpoint.
    """

    policy: CheckpointConfig
    dataset: SourceConfig
    episode: int
    context: int = CONTEXT
    horizon: int | None = None
    output_dir: Path = Path("outputs/dream")
    wandb: WandBConfig = field(default_factory=WandBConfig)

    @property
    def video(self) -> Path:
        """The video to write."""
        return self.output_dir / f"episode_{self.episode}.mp4"

    @property
    def strip(self) -> Path:
        """The strip of pictures to write."""
        return self.video.with_suffix(".png")


def dream_of(cfg: DreamConfig) -> Dreams:
    """Dream of an episode and write its video and strip.

    Raises:
        ValueError: The checkpoint holds no world model, it cannot read the dataset, or the episode does not exist or is
            too short.
    """
    policy = load_world_model(cfg.policy.path)
    with quiet():
        meta = cfg.dataset.metadata([cfg.episode])
        check_features(policy, meta)
        [episode] = load_episodes(policy, cfg.dataset, [cfg.episode], _count_frames(cfg, meta))
    dreams = dream(policy, episode, cfg.context, hold_action=actions_are_targets(meta))
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    write_dream(cfg.video, dreams, meta.fps)
    cfg.strip.write_bytes(figure_bytes(strip_figure(dreams), PNG))
    name, revision = split_revision(cfg.policy.path)
    with wandb_run(cfg.wandb, Path(name), cfg.output_dir, revision) as run:
        if run is not None:
            _log(run, dreams, cfg)
    return dreams


def _count_frames(cfg: DreamConfig, meta: LeRobotDatasetMetadata) -> int:
    """How many frames of the episode are seen and imagined."""
    check_episodes(meta, [cfg.episode])
    length = meta.episodes[cfg.episode]["length"]
    n_frames = length if cfg.horizon is None else cfg.context + cfg.horizon
    if not 1 <= cfg.context < n_frames <= length:
        raise ValueError(
            f"--context={cfg.context}, --horizon={cfg.horizon}: episode {cfg.episode} has {length} frames, of which at "
            "least 1 must be seen and 1 imagined. Choose other values or a longer episode."
        )
    return n_frames


def _log(run: "wandb.Run", dreams: Dreams, cfg: DreamConfig) -> None:
    """Log the video, the strip, and the PSNR in dB of the imagined frames and of a repeated frame."""
    import wandb

    run.log(
        {
            "dream/video": wandb.Video(str(cfg.video), format="mp4"),
            "dream/strip": wandb.Image(str(cfg.strip)),
            "dream/psnr": dreams.psnr(),
            "dream/copy_psnr": dreams.copy_psnr(),
        }
    )


def main() -> None:
    """Entry point of `lerobot-wm dream`."""
    silence()
    cfg = draccus.parse(DreamConfig)
    dreams = dream_of(cfg)
    print(
        f"{dreams.n_imagined} steps: PSNR {dreams.psnr():.1f} dB under true actions, {dreams.copy_psnr():.1f} dB for "
        f"repeating the last frame -> {cfg.video}, {cfg.strip}"
    )

"""`lerobot-wm dream`: what a world model imagines of an episode, as a video and a strip of pictures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.io_utils import write_video

from lerobot_wm.constants import REWARD
from lerobot_wm.pipeline.quiet import quiet, silence
from lerobot_wm.pipeline.source import SourceConfig
from lerobot_wm.policies.latent_policy import LatentPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.report.dream import Dreams, dream, shapes_read
from lerobot_wm.report.dream_figures import strip_figure, video_frames
from lerobot_wm.report.inline import PNG, figure_bytes
from lerobot_wm.report.open_loop import load_world_model

VIDEO_FPS = 15  # at most: episodes of a second or two are over before anything is seen


@dataclass
class CheckpointConfig:
    """`--policy.path`, as in `lerobot-eval`."""

    path: str


@dataclass
class DreamConfig:
    """Flags of `lerobot-wm dream`.

    Args:
        policy: Folder or Hub id of a wm_rssm, wm_bc or wm_iql checkpoint.
        dataset: The image dataset.
        episode: Which of its episodes.
        context: Frames at its beginning that the world model sees.
        horizon: Steps to imagine; None goes on to the end of the episode.
        output_dir: Where episode_N.mp4 and episode_N.png go.
    """

    policy: CheckpointConfig
    dataset: SourceConfig
    episode: int
    context: int = 5
    horizon: int | None = None
    output_dir: Path = Path("outputs/dream")


def dream_of(cfg: DreamConfig) -> Dreams:
    """Dream of an episode and write its video and strip.

    Raises:
        ValueError: The checkpoint holds no world model, the dataset lacks what the policy reads or has it in another
            size, or there is no such episode, or it is too short.
    """
    policy = load_world_model(cfg.policy.path)
    with quiet():
        meta = LeRobotDatasetMetadata(
            cfg.dataset.repo_id, root=cfg.dataset.root, revision=cfg.dataset.revision
        )
        _check_features(policy, meta)
        episode = _read(cfg, meta, [*shapes_read(policy), *({REWARD} & meta.features.keys())])
    dreams = dream(policy, episode, cfg.context)
    video, strip = outputs(cfg)
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    write_video(video, video_frames(dreams), min(meta.fps, VIDEO_FPS))
    strip.write_bytes(figure_bytes(strip_figure(dreams), PNG))
    return dreams


def outputs(cfg: DreamConfig) -> tuple[Path, Path]:
    """The video and the strip to write."""
    return cfg.output_dir / f"episode_{cfg.episode}.mp4", cfg.output_dir / f"episode_{cfg.episode}.png"


def _check_features(policy: WMRSSMPolicy | LatentPolicy, meta: LeRobotDatasetMetadata) -> None:
    """Refuse a dataset without what the policy reads; images of any size are resized."""
    shapes = shapes_read(policy)
    missing = [key for key in shapes if key not in meta.features]
    if missing:
        raise ValueError(
            f"{meta.repo_id} has no {', '.join(missing)}; it has {', '.join(sorted(meta.features))}. Give the "
            "--dataset.repo_id of an image dataset like the one the world model was trained on."
        )
    for key in shapes.keys() - policy.config.cameras:
        found = tuple(meta.features[key]["shape"])
        if found != shapes[key]:
            raise ValueError(
                f"'{key}' of {meta.repo_id} is {found}, the checkpoint was trained on {shapes[key]}: "
                "use the kind of dataset it was trained on."
            )


def _read(cfg: DreamConfig, meta: LeRobotDatasetMetadata, keys: list[str]) -> dict[str, Any]:
    """The first frames of the episode, as many as are seen and imagined: (T, ·) by key, and its task."""
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
    times = [step / meta.fps for step in range(n_frames)]
    dataset = LeRobotDataset(
        meta.repo_id,
        root=cfg.dataset.root,
        revision=cfg.dataset.revision,
        episodes=[cfg.episode],
        delta_timestamps=dict.fromkeys(keys, times),
    )
    return dataset[0]


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

"""`lerobot-wm dream`: a world model sees the first frames of an episode and imagines the rest under several actions."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import draccus
from lerobot.configs.default import WandBConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.evaluate.wandb_log import wandb_run
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
from typing import Any

import numpy as np
import torch
from lerobot.utils.io_utils import write_video
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from matplotlib.ticker import MaxNLocator
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from lerobot_wm.constants import OBS_ENV_STATE, TASK
from lerobot_wm.data.tables import last_action_predicts_next, relative_to_state
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.episodes import ImaginingPolicy, filter_episodes, imagine, reward_key, rssm_of
from lerobot_wm.inspect.open_loop import psnr
from lerobot_wm.inspect.pictures import draw_pictures, tidy
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.world_model.rssm import RSSMState

TRUE_ACTIONS, ZERO_ACTIONS, OWN_ACTIONS = "true actions", "zero actions", "policy's actions"
HELD_ACTION = "held action"  # in place of zero actions, where actions are targets such as joint positions
# Colour-blind safe (Okabe and Ito 2008), blue as on the page. Dashes leave equal curves visible.
STYLES = {
    TRUE_ACTIONS: ("#2f6fde", "-"),
    ZERO_ACTIONS: ("#d55e00", "--"),
    HELD_ACTION: ("#d55e00", "--"),
    OWN_ACTIONS: ("#009e73", ":"),
}
# Imagined steps in a strip, at most.
STEPS_SHOWN = 8
# Players blur small images: a video's are enlarged by a whole factor up to this width in pixels.
PANEL_WIDTH = 256
# Episodes of a second or two would be over before anything is seen.
MAX_VIDEO_FPS = 15
_LINE, _GAP = 28, 8


@dataclass(frozen=True)
class Dream:
    """T frames decoded from latents: those of the filter where the model sees, imagined ones after that.

    Attributes:
        images: (T, K·C, S, S) in [0, 1].
        reward: The predicted reward that arrives with each frame, (T,); the first frame's has no meaning. None without
            a reward head.
    """

    images: Tensor
    reward: Tensor | None


@dataclass(frozen=True)
class Dreams:
    """Dreams of an episode's first T frames, on the CPU.

    Attributes:
        context: How many of the frames the model sees.
        n_cameras: K.
        truth: The images as the world model is shown them, (T, K·C, S, S).
        reward: The dataset's reward that arrives with frame t + 1, (T,); None where it has no such column.
        reward_key: That column's name.
        by_actions: The dream under each kind of action.
    """

    context: int
    n_cameras: int
    truth: Tensor
    reward: Tensor | None
    reward_key: str
    by_actions: dict[str, Dream]

    @property
    def n_imagined(self) -> int:
        """How many frames are imagined."""
        return len(self.truth) - self.context

    def psnr(self) -> float:
        """PSNR in dB of the images imagined under true actions, over all steps together."""
        return self._psnr(self.by_actions[TRUE_ACTIONS].images[self.context :])

    def copy_psnr(self) -> float:
        """PSNR in dB of repeating the last frame seen."""
        return self._psnr(self.truth[self.context - 1])

    def _psnr(self, images: Tensor) -> float:
        return psnr((images - self.truth[self.context :]).square().mean().item())


def actions_are_targets(meta: LeRobotDatasetMetadata) -> bool:
    """Whether a dataset's actions are targets such as joint positions, for which zero is a command like any other."""
    return bool(relative_to_state(meta)) or last_action_predicts_next(meta)


@torch.no_grad()
def dream(policy: ImaginingPolicy, episode: Episode, context: int, *, hold_action: bool = False) -> Dreams:
    """Filter the first frames of an episode and imagine the others, always taking the mean of z_t.

    The kinds of action are those of the episode, zero in the environment's units (no command), and, for a policy, the
    actions it chooses from each imagined latent. With `hold_action`, the last action seen replaces zero. The policy's
    proprioception, and full state if it reads that, stay as they were at the last frame seen: the world model does not
    predict them, and the dataset's own would tell the policy where the demonstration went.

    Args:
        policy: Holds the world model.
        episode: Its first T frames, see `load_episodes`.
        context: How many of them the model sees.
        hold_action: See `actions_are_targets`.

    Raises:
        ValueError: The policy does not know the task.
    """
    world_model, key = rssm_of(policy), reward_key(policy)
    # The filter is causal: its first states do not know the later frames.
    filtered = filter_episodes(world_model, [episode])
    device, last_seen = world_model.action_scaling.offset.device, context - 1
    seen = filtered[0].latents[:context].to(device)  # (context, L)
    true_actions = episode.actions[last_seen:-1]  # (T - context, A)
    if hold_action:
        # Of the frame before the last one seen.
        idle, still = HELD_ACTION, episode.actions[max(last_seen - 1, 0)].expand_as(true_actions)
    else:
        idle, still = ZERO_ACTIONS, torch.zeros_like(true_actions)
    latents = {
        name: imagine(world_model, filtered, last_seen, actions[None])[0]
        for name, actions in ((TRUE_ACTIONS, true_actions), (idle, still))
    }
    if isinstance(policy, LatentPolicy):
        last: dict[str, Any] = {
            key: value[last_seen][None].to(device) for key, value in episode.columns.items()
        }
        states = filtered[0].states
        state = RSSMState(states.deter[last_seen][None].to(device), states.stoch[last_seen][None].to(device))
        latents[OWN_ACTIONS] = _act(policy, state, last | {TASK: [episode.task]}, len(true_actions))

    def decode(imagined: Tensor) -> Dream:
        whole = torch.cat([seen, imagined])  # (T, L)
        reward = world_model.predict_reward(whole).cpu() if world_model.config.predict_reward else None
        return Dream(world_model.decode(whole).cpu(), reward)

    return Dreams(
        context=context,
        n_cameras=len(policy.config.cameras),
        truth=episode.images(),
        # next.success is stored as bool.
        reward=episode.columns[key].float().flatten() if key in episode.columns else None,
        reward_key=key,
        by_actions={name: decode(imagined) for name, imagined in latents.items()},
    )


def _act(policy: LatentPolicy, state: RSSMState, last: dict[str, Any], n_steps: int) -> Tensor:
    """Latents (n_steps, L) that the policy's actions lead to from s_t (1, ·), given the rest of frame t."""
    world_model = rssm_of(policy)
    tasks = policy.one_hot_tasks(last, 1)  # (1, N)
    env_state = last[OBS_ENV_STATE] if policy.config.use_environment_state else None
    proprio = policy.state_at(last)
    targets, reached = policy.config.relative_indices, policy.config.relative_state_indices
    latents = []
    for _ in range(n_steps):
        action = policy.act(policy.observation(proprio, tasks, state.latent, env_state), proprio)  # (1, A)
        # Where the action is a target for the state, the state is imagined to reach it.
        proprio = proprio.clone()
        proprio[:, reached] = action[:, targets]
        state = world_model.imagine(state, action[:, None]).last()
        latents.append(state.latent)
    return torch.cat(latents)


def strip_figure(dreams: Dreams) -> Figure:
    """Truth and dreams as rows and steps as columns; beneath them the reward as curves, where there is a reward head.

    The first column is the last frame seen, which the world model reconstructs.
    """
    steps = np.unique(
        np.linspace(0, dreams.n_imagined, min(dreams.n_imagined, STEPS_SHOWN) + 1).round().astype(int)
    )
    rows = _images_by_row(dreams)
    has_reward = dreams.by_actions[TRUE_ACTIONS].reward is not None
    _, height, width, _ = rows["truth"].shape
    # In inches.
    cell_width, cell_height = 1.25, 1.25 * height / width
    figure = Figure(
        figsize=(cell_width * len(steps) + 1.2, cell_height * len(rows) + 0.4 + 2.1 * has_reward),
        layout="constrained",
    )
    grid = figure.add_gridspec(
        len(rows) + has_reward, len(steps), height_ratios=[cell_height] * len(rows) + [1.8] * has_reward
    )
    axes = np.array(
        [[figure.add_subplot(grid[row, column]) for column in range(len(steps))] for row in range(len(rows))]
    )
    draw_pictures(axes, [(name, list(images[dreams.context - 1 + steps])) for name, images in rows.items()])
    for axis, step in zip(axes[0], steps, strict=True):
        axis.set_title(f"+{step}" if step else "last seen", fontsize=9)
    if has_reward:
        _draw_rewards(figure.add_subplot(grid[-1, :]), dreams)
        figure.legend(loc="outside lower center", ncols=5, fontsize=8)
    return figure


def _draw_rewards(axes: Axes, dreams: Dreams) -> None:
    """Draw the reward against the frame it arrives with; none arrives with the first frame."""
    steps = np.arange(1, len(dreams.truth))
    if dreams.reward is not None:
        label = f"truth ({dreams.reward_key})"
        axes.plot(steps, dreams.reward[:-1], color="black", linewidth=1.2, label=label)
    for name, imagined in dreams.by_actions.items():
        assert imagined.reward is not None
        colour, style = STYLES[name]
        axes.plot(steps, imagined.reward[1:], style, color=colour, linewidth=1.5, label=name)
    axes.axvline(dreams.context - 1, color="#7a7a7a", linewidth=0.8, label="last seen")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("step of the episode", fontsize=8)
    axes.set_ylabel("reward", fontsize=8)
    tidy(axes)


def write_dream(path: Path, dreams: Dreams, fps: int) -> None:
    """Write the video of dreams of a dataset recorded at `fps` frames per second."""
    write_video(path, video_frames(dreams), min(fps, MAX_VIDEO_FPS))


def video_frames(dreams: Dreams) -> list[np.ndarray]:
    """Truth and dreams side by side under their names: T frames (H, W, 3) uint8 of even size."""
    rows = _images_by_row(dreams)
    n_frames, height, width, _ = rows["truth"].shape
    factor = max(1, PANEL_WIDTH // width)
    size = (factor * width, factor * height)
    canvas_size = ((size[0] + _GAP) * len(rows) + _GAP, size[1] + 2 * _LINE)
    font = ImageFont.truetype(findfont("DejaVu Sans"), 15)
    frames = []
    for t in range(n_frames):
        canvas = Image.new("RGB", canvas_size, "white")
        draw = ImageDraw.Draw(canvas)
        for i, (name, images) in enumerate(rows.items()):
            left = _GAP + i * (size[0] + _GAP)
            draw.text((left + size[0] // 2, _LINE // 2), name, fill="black", font=font, anchor="mm")
            canvas.paste(Image.fromarray(images[t]).resize(size, Image.Resampling.NEAREST), (left, _LINE))
        ahead = t - dreams.context + 1
        text = f"step {t}: imagined, +{ahead}" if ahead > 0 else f"step {t}: seen"
        draw.text((_GAP, canvas_size[1] - _LINE // 2), text, fill="black", font=font, anchor="lm")
        frames.append(np.asarray(canvas))
    return frames


def _images_by_row(dreams: Dreams) -> dict[str, np.ndarray]:
    """Truth and dreams by name, each (T, K·H, W, C) uint8: the K cameras one above the other."""
    images = {"truth": dreams.truth} | {name: dream.images for name, dream in dreams.by_actions.items()}
    stacked = {
        name: of_row.unflatten(1, (dreams.n_cameras, -1)).permute(0, 1, 3, 4, 2).flatten(1, 2)
        for name, of_row in images.items()
    }
    return {name: (255 * of_row).round().byte().numpy() for name, of_row in stacked.items()}


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

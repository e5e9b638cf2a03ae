"""Dreams to be looked at: a strip of pictures with the reward beneath, and the frames of a video."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import fill

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.io_utils import write_video
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from matplotlib.ticker import MaxNLocator
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.constants import TASK
from lerobot_wm.data.options import SourceConfig
from lerobot_wm.inspect.dream import OWN_ACTIONS, TRUE_ACTIONS, ZERO_ACTIONS, Dreams, dream
from lerobot_wm.inspect.episodes import episodes_by_task, read_episodes
from lerobot_wm.inspect.html import MP4, PNG, data_uri, figure_bytes
from lerobot_wm.inspect.open_loop import CONTEXT
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy

# Colour-blind safe (Okabe and Ito 2008), blue as on the page; dashes hide nothing where curves are equal.
STYLES = {TRUE_ACTIONS: ("#2f6fde", "-"), ZERO_ACTIONS: ("#d55e00", "--"), OWN_ACTIONS: ("#009e73", ":")}
STEPS_SHOWN = 8  # imagined steps in a strip, at most
# Of a video, in pixels: images are enlarged by a whole factor up to this width, since players blur small ones.
PANEL_WIDTH = 256
_LINE, _GAP = 28, 8


def strip_figure(dreams: Dreams) -> Figure:
    """Truth and dreams as rows, steps as columns, and beneath them the reward as curves where there is a reward head.

    The first column is the last frame seen: the world model has reconstructed it, not imagined.
    """
    n_imagined = len(dreams.truth) - dreams.context
    ahead = np.unique(np.linspace(0, n_imagined, min(n_imagined, STEPS_SHOWN) + 1).round().astype(int))
    rows = _rows(dreams)
    has_reward = dreams.dreams[TRUE_ACTIONS].reward is not None
    _, height, width, _ = rows["truth"].shape
    cell = 1.25 * height / width  # inches high, 1.25 wide
    figure = Figure(
        figsize=(1.25 * len(ahead) + 1.2, cell * len(rows) + 0.4 + 2.1 * has_reward), layout="constrained"
    )
    grid = figure.add_gridspec(
        len(rows) + has_reward, len(ahead), height_ratios=[cell] * len(rows) + [1.8] * has_reward
    )
    for row, (name, images) in enumerate(rows.items()):
        for column, steps in enumerate(ahead):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(images[dreams.context - 1 + steps], interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            if row == 0:
                axes.set_title(f"+{steps}" if steps else "last seen", fontsize=9)
            if column == 0:
                axes.set_ylabel(fill(name, 10), fontsize=9, rotation=0, ha="right", va="center")
    if has_reward:
        _draw_rewards(figure.add_subplot(grid[-1, :]), dreams)
        figure.legend(loc="outside lower center", ncols=5, fontsize=8)
    return figure


def _draw_rewards(axes: Axes, dreams: Dreams) -> None:
    """Reward against the frame it arrives with; the first frame has none."""
    steps = np.arange(1, len(dreams.truth))
    if dreams.reward is not None:
        axes.plot(
            steps, dreams.reward[:-1], color="black", linewidth=1.2, label=f"truth ({dreams.reward_key})"
        )
    for name, dreamt in dreams.dreams.items():
        assert dreamt.reward is not None  # the world model has a reward head
        colour, style = STYLES[name]
        axes.plot(steps, dreamt.reward[1:], style, color=colour, linewidth=1.5, label=name)
    axes.axvline(dreams.context - 1, color="#7a7a7a", linewidth=0.8, label="last seen")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("step of the episode", fontsize=8)
    axes.set_ylabel("reward", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)


def video_frames(dreams: Dreams) -> list[np.ndarray]:
    """Truth and dreams side by side under their names: T frames (H, W, 3) uint8 of even size."""
    rows = _rows(dreams)
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


def _rows(dreams: Dreams) -> dict[str, np.ndarray]:
    """Truth and dreams by name, each (T, K·H, W, C) uint8: the K cameras one above the other."""
    images = {"truth": dreams.truth} | {name: dream.images for name, dream in dreams.dreams.items()}
    return {name: _pixels(of_name, dreams.n_cameras) for name, of_name in images.items()}


def _pixels(images: Tensor, n_cameras: int) -> np.ndarray:
    """(T, K·C, H, W) in [0, 1] -> (T, K·H, W, C) uint8."""
    stacked = images.unflatten(1, (n_cameras, -1)).permute(0, 1, 3, 4, 2).flatten(1, 2)  # (T, K·H, W, C)
    return (255 * stacked).round().byte().numpy()


MAX_DREAMS = 3  # one for each of the first tasks
MAX_FRAMES = 120  # of an episode; Meta-World's experts need fewer
VIDEO_FPS = 15  # at most: episodes of a second or two are over before anything is seen


@dataclass(frozen=True)
class DreamClip:
    """The dreams of one episode; `video` and `strip` are data URIs, `kinds` what stands beside the truth, in order."""

    task: str
    episode: int
    n_imagined: int
    kinds: list[str]
    psnr: float
    copy_psnr: float
    video: str
    strip: str


def dream_clips(
    policy: WMRSSMPolicy | LatentPolicy, meta: LeRobotDatasetMetadata, source: SourceConfig
) -> list[DreamClip]:
    """Dream of the last episode of each of the first tasks.

    A policy's own actions are dreamt of too; tasks that it does not know are left out.

    Args:
        policy: The world model, or a policy on it.
        meta: A dataset that it can read, see `check_features`.
        source: Where it is.
    """
    by_task = episodes_by_task(meta, min_length=CONTEXT + 1)
    if isinstance(policy, LatentPolicy):
        by_task = {task: episodes for task, episodes in by_task.items() if task in policy.config.tasks}
    chosen = sorted(episodes[-1] for episodes in list(by_task.values())[:MAX_DREAMS])
    if not chosen:
        return []
    episodes = read_episodes(policy, meta, source, chosen, MAX_FRAMES)
    return [
        _clip(dream(policy, episode, CONTEXT), episode[TASK], index, meta.fps)
        for index, episode in zip(tqdm(chosen, desc="Dreaming", unit="episode"), episodes, strict=True)
    ]


def write_dream(path: Path, dreams: Dreams, fps: int) -> None:
    """Write the video of dreams of a dataset that was recorded at `fps` frames per second."""
    write_video(path, video_frames(dreams), min(fps, VIDEO_FPS))


def _clip(dreams: Dreams, task: str, episode: int, fps: int) -> DreamClip:
    with TemporaryDirectory() as folder:
        path = Path(folder, "dream.mp4")
        write_dream(path, dreams, fps)
        video = path.read_bytes()
    return DreamClip(
        task=task,
        episode=episode,
        n_imagined=len(dreams.truth) - dreams.context,
        kinds=list(dreams.dreams),
        psnr=dreams.psnr(),
        copy_psnr=dreams.copy_psnr(),
        video=data_uri(video, MP4),
        strip=data_uri(figure_bytes(strip_figure(dreams), PNG), PNG),
    )

"""Dreams to be looked at: a strip of pictures with the reward beneath, and the frames of a video."""

from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont
from matplotlib.ticker import MaxNLocator
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from lerobot_wm.report.dream import OWN_ACTIONS, TRUE_ACTIONS, ZERO_ACTIONS, Dreams

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
    for name, dream in dreams.dreams.items():
        assert dream.reward is not None  # the world model has a reward head
        colour, style = STYLES[name]
        axes.plot(steps, dream.reward[1:], style, color=colour, linewidth=1.5, label=name)
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

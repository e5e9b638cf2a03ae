"""Open-loop prediction for a card: an animation, real frames above imagined ones, and a table of its error."""

import io

import numpy as np
from PIL import Image

from lerobot_wm.report.open_loop import CONTEXT, HORIZONS, OpenLoop
from lerobot_wm.report.tables import Cell, ReportTable

SCALE = 2  # pixels of the animation per pixel of an image
FRAME_MS = 80
PAUSE_MS = 1000  # on the last frame, before it begins again


def animation(results: list[OpenLoop]) -> bytes:
    """A WebP file that loops, a column per task. A white line between the two appears when the model imagines.

    Args:
        results: one per task.
    """
    columns = [_column(result) for result in results]
    frames = np.concatenate(columns, axis=2).repeat(SCALE, axis=1).repeat(SCALE, axis=2)  # (T, H, W, 3)
    pictures = [Image.fromarray(frame) for frame in frames]
    durations = [FRAME_MS] * (len(pictures) - 1) + [PAUSE_MS]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer, "WEBP", save_all=True, append_images=pictures[1:], duration=durations, loop=0, quality=70
    )
    return buffer.getvalue()


def psnr_table(results: list[OpenLoop]) -> ReportTable:
    """Tasks down, steps ahead of the last frame seen across."""
    rows: list[tuple[str, list[Cell]]] = [
        (
            result.task,
            [f"{ours:.1f} ({copy:.1f})" for ours, copy in zip(result.psnr, result.copy_psnr, strict=True)],
        )
        for result in results
    ]
    episodes = max(result.n_episodes for result in results)
    note = (
        f"PSNR in dB of images imagined from {CONTEXT} frames and the actions that followed, over the last episodes of "
        f"each task (up to {episodes}); in brackets: of repeating the last frame seen."
    )
    return ReportTable("Open-loop prediction", "task", [f"+{step}" for step in HORIZONS], rows, notes=[note])


def _column(result: OpenLoop) -> np.ndarray:
    """Frames of one task, (T, 2H + 1, W, 3) uint8: truth, a line, what the model saw and then imagines."""
    below = np.concatenate([result.truth[:CONTEXT], result.imagined])  # (T, C, H, W)
    line = np.zeros_like(below[:, :, :1])
    line[CONTEXT:] = 1
    stacked = np.concatenate([result.truth, line, below], axis=2)
    return (255 * stacked.clip(0, 1)).round().astype(np.uint8).transpose(0, 2, 3, 1)

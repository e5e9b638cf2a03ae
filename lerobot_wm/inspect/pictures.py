"""Figures, pictures and videos as bytes and as data URIs."""

import io
from base64 import b64encode
from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogFormatter

SVG, PNG, WEBP, MP4 = "image/svg+xml", "image/png", "image/webp", "video/mp4"
MAX_NAME_LENGTH = 32


def data_uri(content: bytes, mime_type: str) -> str:
    """A `src` attribute that holds the content itself, so that one HTML file needs no other."""
    return f"data:{mime_type};base64,{b64encode(content).decode()}"


def shorten(name: str) -> str:
    """Cut a name so that it leaves room for the figure beside it."""
    return name if len(name) <= MAX_NAME_LENGTH else f"{name[: MAX_NAME_LENGTH - 1]}…"


def draw_pictures(axes: np.ndarray, rows: Sequence[tuple[str, Sequence[np.ndarray | None]]]) -> None:
    """Draw rows of pictures (H, W, C) on a grid of axes (R, N), each row's name to its left; None leaves a gap."""
    for row, (name, pictures) in zip(axes, rows, strict=True):
        for axis, picture in zip(row, pictures, strict=True):
            axis.set_xticks([])
            axis.set_yticks([])
            if picture is None:
                axis.spines[:].set_visible(False)
            else:
                axis.imshow(picture, interpolation="nearest")
        row[0].set_ylabel(fill(name, 14), fontsize=8, rotation=0, ha="right", va="center")


def tidy(axes: Axes, title: str = "") -> None:
    """Give a panel of curves its title, small numbers and a pale grid."""
    axes.set_title(title, fontsize=10)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)


def log_scale(axes: Axes) -> None:
    """Make the vertical axis logarithmic, its numbers without mathematics, which `figure_bytes` does not typeset."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(LogFormatter())


def figure_bytes(figure: Figure, mime_type: str) -> bytes:
    """A matplotlib figure as a PNG or SVG file, without a date."""
    buffer = io.BytesIO()
    for text in figure.findobj(Text):
        # The name of a task or arm may contain $.
        text.set_parse_math(False)
    metadata = {"Date": None} if mime_type == SVG else {}
    figure.savefig(buffer, format="svg" if mime_type == SVG else "png", dpi=100, metadata=metadata)
    return buffer.getvalue()


def figure_uri(figure: Figure, mime_type: str) -> str:
    """A matplotlib figure as a data URI."""
    return data_uri(figure_bytes(figure, mime_type), mime_type)

"""Pictures and videos as data URIs, so that one HTML file holds everything."""

import io
from base64 import b64encode
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure
from matplotlib.text import Text

MAX_NAME = 32  # characters of a name that stands in a figure
SVG, PNG, WEBP, MP4 = "image/svg+xml", "image/png", "image/webp", "video/mp4"


def data_uri(content: bytes, mime_type: str) -> str:
    """A `src` attribute that carries the content itself."""
    return f"data:{mime_type};base64,{b64encode(content).decode()}"


def short(name: str) -> str:
    """A name that leaves room for the figure it stands beside."""
    return name if len(name) <= MAX_NAME else f"{name[: MAX_NAME - 1]}…"


def figure_bytes(figure: Figure, mime_type: str) -> bytes:
    """A matplotlib figure as a PNG or SVG file."""
    buffer = io.BytesIO()
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # the name of a task or arm may hold $
    # Date=None: the same figure gives the same bytes.
    metadata = {"Date": None} if mime_type == SVG else {}
    figure.savefig(buffer, format="svg" if mime_type == SVG else "png", dpi=100, metadata=metadata)
    return buffer.getvalue()


def template_environment() -> Environment:
    """Jinja for the templates in report/templates: what it is given is escaped, and nothing may be missing."""
    return Environment(
        loader=FileSystemLoader(Path(__file__).parents[1] / "report" / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )

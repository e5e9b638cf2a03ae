"""The templates of cards. What they show is escaped: a task's name must not become a table's border or a link."""

import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

# What Markdown reads anywhere in a line; an underscore only at the edge of a word.
_SPECIAL = re.compile(r"[\\`*\[\]<>|#~]|(?<![^\W_])_|_(?![^\W_])")


class Markdown(str):
    """Text that is Markdown already; a template shows any other value escaped."""


def render(template: str, **values: object) -> str:
    """A template beside this module, filled in; nothing it asks for may be missing."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        finalize=escaped,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["code"] = code
    environment.filters["python"] = python
    environment.filters["raw"] = Markdown
    return environment.get_template(template).render(**values)


def escaped(value: Any) -> str:
    """A value as one line of plain text in Markdown, in a table too."""
    if isinstance(value, Markdown):
        return value
    return _SPECIAL.sub(r"\\\g<0>", re.sub(r"\s+", " ", str(value)))


def code(value: object) -> Markdown:
    """A value as code within a line; a backtick would end it, a pipe a table's cell."""
    text = " ".join(str(value).split()).replace("`", "'").replace("|", r"\|")
    return Markdown(f"`{text}`")


def python(value: object) -> Markdown:
    """A value as a Python literal within a block of code."""
    return Markdown(repr(value))

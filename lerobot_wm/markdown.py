"""Markdown from templates; values are escaped, so that a task's name cannot become a link or a table's border."""

import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

# Characters with a meaning anywhere in a line of Markdown; an underscore has one only at the edge of a word.
_SPECIAL = re.compile(r"[\\`*\[\]<>|#~]|(?<![^\W_])_|_(?![^\W_])")


class Markdown(str):
    """Text that is already Markdown; templates escape all other values."""


def render(template: Path, **values: object) -> str:
    """Fill in a Jinja template; every value it uses must be given."""
    environment = Environment(
        loader=FileSystemLoader(template.parent),
        finalize=escaped,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["code"] = code
    environment.filters["python"] = python
    environment.filters["raw"] = Markdown
    return environment.get_template(template.name).render(**values)


def escaped(value: Any) -> str:
    """A value as one line of plain text, safe in a Markdown table too."""
    if isinstance(value, Markdown):
        return value
    return _SPECIAL.sub(r"\\\g<0>", re.sub(r"\s+", " ", str(value)))


def code(value: object) -> Markdown:
    """A value as inline code; backticks and pipes, which would end the code or a table's cell, are replaced."""
    text = " ".join(str(value).split()).replace("`", "'").replace("|", r"\|")
    return Markdown(f"`{text}`")


def python(value: object) -> Markdown:
    """A value as a Python literal, for a code block."""
    return Markdown(repr(value))

"""The commands and programs in README and docs, as tests run them."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[1]


def blocks(document: str, language: str) -> list[str]:
    """Every fenced block of a language in a document, named from the repository's root."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)


def commands(document: str) -> list[list[str]]:
    """The words of each command in the bash blocks of a document, with the user's name put in."""
    text = "".join(blocks(document, "bash")).replace("\\\n", " ").replace("$USER", "test")
    lines = [shlex.split(line, comments=True) for line in text.splitlines()]
    return [words for words in lines if words]


def with_flags(words: list[str], **flags: object) -> list[str]:
    """A command with some of its flags, all of which it must have, set to other values."""
    for name, value in flags.items():
        places = [i for i, word in enumerate(words) if word.startswith(f"--{name}=")]
        assert len(places) == 1, f"{' '.join(words)} has no --{name}"
        words = [*words[: places[0]], f"--{name}={value}", *words[places[0] + 1 :]]
    return words

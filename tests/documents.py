"""What tests read in README and docs: commands, programs and tables."""

import re
import shlex
from pathlib import Path

ROOT = Path(__file__).parents[1]


def blocks(document: str, language: str) -> list[str]:
    """Every fenced block of a language in a document, named from the repository's root."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / document).read_text(), re.DOTALL)


def commands(document: str) -> list[list[str]]:
    """The words of each command in the bash blocks of a document, with the user's name put in."""
    return commands_of("".join(blocks(document, "bash")))


def commands_of(text: str) -> list[list[str]]:
    """The words of each command in a bash block, with the user's name put in."""
    text = text.replace("\\\n", " ").replace("$USER", "test")
    lines = [shlex.split(line, comments=True) for line in text.splitlines()]
    return [words for words in lines if words]


def with_flags(words: list[str], **flags: object) -> list[str]:
    """A command with some of its flags, all of which it must have, set to other values."""
    for name, value in flags.items():
        places = [i for i, word in enumerate(words) if word.startswith(f"--{name}=")]
        assert len(places) == 1, f"{' '.join(words)} has no --{name}"
        words = [*words[: places[0]], f"--{name}={value}", *words[places[0] + 1 :]]
    return words


def documents() -> list[str]:
    """Every document that a reader is led to, named from the repository's root."""
    return [
        "README.md",
        "CONTRIBUTING.md",
        *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))),
    ]


def tables(document: str, heading: str) -> list[list[dict[str, str]]]:
    """The tables under a heading, up to the next heading of its level; each row by the column's title."""
    level = heading.split()[0]
    [_, after] = f"\n{(ROOT / document).read_text()}".split(f"\n{heading}\n")
    section = re.split(rf"^{level} ", after, flags=re.MULTILINE)[0]
    found = []
    for block in re.findall(r"(?:^ *\|.*\n)+", section, re.MULTILINE):
        lines = [re.split(r"(?<!\\)\|", line.strip())[1:-1] for line in block.splitlines()]
        title, _, *rows = [[cell.strip() for cell in cells] for cells in lines]
        found.append([dict(zip(title, row, strict=True)) for row in rows])
    return found

"""docs/faults.md quotes what the code says."""

import re

import pytest

from tests.documents import ROOT

PAGE = (ROOT / "docs" / "faults.md").read_text()
QUOTED = re.findall(r"^\| .* \| `([^|]+)` \|$", PAGE, re.MULTILINE)
CODE = "\n".join(path.read_text() for path in sorted((ROOT / "lerobot_wm").rglob("*.py")))
CODE = re.sub(r'"\s*\n\s*f?"', "", CODE)  # messages that go on in the next line


def test_most_rows_quote_a_message() -> None:
    assert len(QUOTED) > 20


@pytest.mark.parametrize("message", QUOTED)
def test_messages_are_those_of_the_code(message: str) -> None:
    pattern = ".*".join(re.escape(part) for part in message.split("..."))
    assert re.search(pattern, CODE), message

"""A long run holds at its end what it held after its warm-up."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.documents import ROOT

GROWTH = 0.05  # of memory


@pytest.mark.slow
def test_nothing_grows(tmp_path: Path) -> None:
    output = tmp_path / "long_run.json"
    script = ROOT / "results" / "faults" / "long_run.py"
    subprocess.run([sys.executable, str(script), f"--output={output}"], check=True)
    check(output)


def test_the_recorded_run() -> None:
    check(ROOT / "results" / "faults" / "long_run.json")


def check(output: Path) -> None:
    rows = json.loads(output.read_text())["rows"]
    assert rows["resets"]["contexts"] == [0, 6]  # one of each task, or none
    for row in rows.values():
        before, after = row["after warm-up"], row["at the end"]
        assert row["growth of memory"] < GROWTH
        assert after["files"] <= before["files"]
        assert after["threads"] <= before["threads"]

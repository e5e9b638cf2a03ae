"""The whole experiment at its smallest, through its script."""

import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from lerobot_wm.constants import MT6
from lerobot_wm.records import read_records, record_line
from lerobot_wm.report.arms import ARMS

SCRIPT = Path("scripts") / "reproduce_table1.py"
ROLLOUTS = 2 * len(MT6)  # of each arm in the preset `smoke`

pytestmark = pytest.mark.slow


def reproduce(folder: Path, *flags: str) -> str:
    """Run the preset `smoke` in a folder; returns what it prints."""
    command = [sys.executable, str(SCRIPT), "--preset=smoke", f"--output_dir={folder}", *flags]
    result = subprocess.run([*command, f"--results_dir={folder / 'none'}"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All arms and the world model's quality."""
    folder = tmp_path_factory.mktemp("smoke") / "outputs"
    reproduce(folder, "--quality")
    return folder


def test_every_arm_is_rolled_out_once(finished: Path) -> None:
    records = read_records([finished / "records.jsonl"])
    assert Counter(record["arm"] for record in records) == dict.fromkeys(ARMS, ROLLOUTS)
    assert {record["preset"] for record in records} == {"smoke"}
    assert {record["seed"] for record in records} == {0}
    assert (finished / "report" / "index.html").stat().st_size > 10_000
    assert "Stages to run: 0" in reproduce(finished, "--quality", "--list")


def test_a_killed_training_resumes_from_its_checkpoint(finished: Path) -> None:
    finished = finished.rename(finished.with_name("moved"))  # the folder may have been moved too
    records = finished / "own_records.jsonl"  # records.jsonl is made from it
    before = read_records([records])
    # The state after a kill that followed the first checkpoint.
    run = finished / "seed_0" / "wm_bc"
    shutil.rmtree(run / "checkpoints" / "000020")
    (run / "checkpoints" / "last").unlink()
    (run / "checkpoints" / "last").symlink_to("000010")
    shutil.rmtree(finished / "seed_0" / "eval_wm_bc")
    records.write_text("".join(record_line(record) for record in before if record["arm"] != "wm_bc"))

    shown = reproduce(finished, "--arms=wm_bc", "--list")
    assert "to resume" in shown
    assert "Stages to run: 2" in shown
    reproduce(finished, "--arms=wm_bc")
    assert "--resume=true" in (finished / "seed_0" / "wm_bc.log").read_text()
    after = read_records([records])
    assert sorted(map(record_line, after)) == sorted(map(record_line, before))

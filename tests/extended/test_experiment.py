"""From stages to records: finished arms are recorded once, failed ones are named, committed ones do not run."""

import gzip
import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from lerobot_wm.experiment.experiment import Experiment, main, show_failures
from lerobot_wm.experiment.plan import Plan
from lerobot_wm.experiment.preset import load_preset
from lerobot_wm.experiment.stage import Stage
from lerobot_wm.files import sole_writer
from lerobot_wm.records import read_records
from lerobot_wm.report.arms import ARMS, Arm

# Writes the two rollouts of an arm: python -c ROLL_OUT FOLDER ARM SEED
ROLL_OUT = """
import json, pathlib, sys
folder, arm, seed = pathlib.Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
assert arm != "wm_iql", "no such luck"
folder.mkdir(parents=True)
record = {"arm": arm, "policy_type": "wm_bc", "preset": "smoke", "seed": seed, "task": "reach-v3", "seen": True,
          "success": True, "steps": 1, "return": 1.0}
lines = [json.dumps({**record, "variation": k}) for k in (0, 1)]
(folder / "records.jsonl").write_text("\\n".join(lines) + "\\n")
(folder / "done").touch()
"""


class QuickPlan(Plan):
    """Arms whose rollouts need no training."""

    def evaluations(self, arm: Arm, seed: int) -> list[Stage]:
        folder = self.output_dir / f"{arm.name}_{seed}"
        argv = (sys.executable, "-c", ROLL_OUT, str(folder), arm.name, str(seed))
        return [Stage(folder.name, "evaluate", argv, folder, folder / "done")]


def experiment(folder: Path, arms: list[tuple[str, int]]) -> Experiment:
    plan = QuickPlan(replace(load_preset("smoke"), tasks="reach-v3"), folder / "outputs", 42)
    runs = [(ARMS[name], seed) for name, seed in arms]
    return Experiment(plan, runs, folder / "results", processes=2, quality=False)


def run(folder: Path, arms: list[tuple[str, int]]) -> tuple[list[Stage], str]:
    """Run these arms; returns what failed and what was printed."""
    with (folder / "printed").open("w+") as file:
        console = Console(file=file, width=200)
        with sole_writer(folder / "outputs") as lock:
            failed = experiment(folder, arms).run(lock, console)
        show_failures(failed, console)
        file.seek(0)
        return failed, file.read()


def recorded(folder: Path) -> list[tuple[str, int | None]]:
    records = read_records([folder / "outputs" / "own_records.jsonl"])
    return sorted({(record["arm"], record["seed"]) for record in records})


def test_a_failed_arm_is_named_with_its_log_and_stops_no_other(tmp_path: Path) -> None:
    failed, printed = run(tmp_path, [("wm_iql", 0), ("wm_bc", 0), ("wm_bc", 1)])
    assert [stage.name for stage in failed] == ["wm_iql_0"]
    assert "AssertionError: no such luck" in printed
    assert recorded(tmp_path) == [("wm_bc", 0), ("wm_bc", 1)]


def test_finished_arms_are_not_run_again_and_new_ones_are_added(tmp_path: Path) -> None:
    run(tmp_path, [("wm_bc", 0)])
    assert "wm_bc_0" not in run(tmp_path, [("wm_bc", 0), ("state_bc", 0)])[1]
    assert recorded(tmp_path) == [("state_bc", 0), ("wm_bc", 0)]


def test_rollouts_that_a_killed_run_left_behind_are_recorded(tmp_path: Path) -> None:
    run(tmp_path, [("wm_bc", 0)])
    (tmp_path / "outputs" / "own_records.jsonl").unlink()
    _, printed = run(tmp_path, [("wm_bc", 0)])
    assert printed == ""
    assert recorded(tmp_path) == [("wm_bc", 0)]


@pytest.fixture
def committed(tmp_path: Path) -> Path:
    """A folder where wm_bc's records are committed and its outputs are gone."""
    run(tmp_path, [("wm_bc", 0)])
    (tmp_path / "results").mkdir()
    own = tmp_path / "outputs" / "own_records.jsonl"
    (tmp_path / "results" / "records.jsonl.gz").write_bytes(gzip.compress(own.read_bytes()))
    own.unlink()
    (tmp_path / "outputs" / "wm_bc_0" / "done").unlink()
    return tmp_path


def test_committed_records_count_as_done(committed: Path) -> None:
    assert run(committed, [("wm_bc", 0)])[1] == ""
    assert not (committed / "outputs" / "wm_bc_0" / "done").exists()
    times = json.loads((committed / "outputs" / "times.json").read_text())
    assert list(times) == ["wm_bc_0"]


def test_arms_whose_records_are_committed_are_named(committed: Path) -> None:
    """Changed settings have no effect on them."""
    with (committed / "printed").open("w+") as file:
        arms = experiment(committed, [("wm_bc", 0), ("wm_bc", 1)])
        arms.name_committed(Console(file=file, width=200))
        file.seek(0)
        printed = file.read().replace("\n", "")
    for fact in (str(committed / "results" / "records.jsonl.gz"), "wm_bc 0", "--results_dir"):
        assert fact in printed
    assert "wm_bc 1" not in printed


def test_list_shows_what_is_done_and_what_is_left_and_writes_nothing(committed: Path) -> None:
    before = sorted(committed.rglob("*"))
    with io.StringIO() as file:
        experiment(committed, [("wm_bc", 0), ("wm_bc", 1)]).show(Console(file=file, width=80))
        lines = [" ".join(line.split()) for line in file.getvalue().splitlines()]
    assert sorted(committed.rglob("*")) == before
    assert "wm_bc, seed 0 records complete" in lines
    assert any(line.startswith("wm_bc_1 to run") for line in lines)
    assert lines[-1].startswith("Stages to run: 1, about")


@pytest.mark.parametrize(
    ("flags", "facts"),
    [
        ("--preset=huge", ("'huge'", "cpu")),
        ("--preset=smoke --arms=wm_cb", ("wm_cb", "wm_bc")),
    ],
)
def test_unknown_names_are_refused_with_the_known_ones(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    flags: str,
    facts: tuple[str, ...],
) -> None:
    output_dir = tmp_path / "outputs"
    monkeypatch.setattr(sys, "argv", ["reproduce_table1.py", f"--output_dir={output_dir}", *flags.split()])
    with pytest.raises(SystemExit) as end:
        main()
    printed = f"{end.value} {capsys.readouterr().err}"
    assert all(fact in printed for fact in facts)
    assert not output_dir.exists()

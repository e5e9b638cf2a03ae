"""`python -m benchmarks`: alternation, statistics, the comparison of losses, and the command line."""

import ast
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as command
from benchmarks import memory
from benchmarks.environments import OWN, PINS
from benchmarks.measure import SideError, Spread, check_losses, measure_row, speed_up
from benchmarks.rows import ROWS, Row, Side
from benchmarks.sides import shared
from benchmarks.table import number
from benchmarks.timing import rate
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_iql.configuration_wm_iql import WMIQLConfig
from tests.extended import benchmark_sides

ROOT = Path(__file__).parents[2]
SIZES = tuple({"batch": batch, "seconds": 1.0} for batch in (1, 2, 3))


def row(*peers: str, ours: str = "ours", **settings: Any) -> Row:
    def side(name: str) -> Side:
        return Side(name, f"benchmark_sides:{name}")

    return Row("row", "a row", "steps/s", side(ours), tuple(map(side, peers)), SIZES, **settings)


@pytest.fixture(autouse=True)
def importable_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other packages bring a `tests` of their own, which the sides' processes would find first."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests" / "extended"))


def test_sides_are_measured_by_turns(tmp_path: Path) -> None:
    [result] = measure_row(row("peer"), SIZES[0], tmp_path, threads=2, repeats=3)
    assert (tmp_path / benchmark_sides.ORDER).read_text().split() == ["ours", "peer"] * 3
    assert (result.ours, result.peer, result.ratio, result.peer_name) == (20.0, 5.0, 4.0, "peer")
    assert result.spread == {"ours": [10.0, 40.0], "peer": [4.0, 6.0]}
    assert result.sizes == {"batch": 1, "seconds": 1.0, "threads": 2}
    assert result.facts == {"ours": {"loss": 100.0}, "peer": {"loss": 100.001}}


def test_row_without_peer_has_no_ratio(tmp_path: Path) -> None:
    [result] = measure_row(row(), SIZES[0], tmp_path, threads=1, repeats=1)
    assert (result.ours, result.peer, result.peer_name, result.ratio) == (10.0, None, None, None)


def test_sides_with_other_losses_are_not_compared(tmp_path: Path) -> None:
    with pytest.raises(SideError, match=r"loss.*100\.0.*101\.0"):
        measure_row(row("stranger"), SIZES[0], tmp_path, threads=1, repeats=1)


def test_failing_side_says_why(tmp_path: Path) -> None:
    with pytest.raises(SideError, match="no batch of 1 for you"):
        measure_row(row("broken"), SIZES[0], tmp_path, threads=1, repeats=1)


def test_a_side_that_dies_while_it_waits_says_so(tmp_path: Path) -> None:
    with pytest.raises(SideError, match=r"mortal"):
        measure_row(row("mortal", ours="slow"), SIZES[0], tmp_path, threads=1, repeats=2)


def test_losses_are_compared_part_by_part() -> None:
    check_losses({"a": {"loss": 100.0, "kl": 1.0, "dtype": "float32"}, "b": {"loss": 100.005, "kl": 1.0}})
    check_losses({"a": {}, "b": {"loss": 1.0}})
    with pytest.raises(SideError, match="kl"):
        check_losses({"a": {"loss": 100.0, "kl": 1.0}, "b": {"loss": 100.0, "kl": 1.001}})


def test_statistics() -> None:
    assert Spread.of([3.0, 1.0, 8.0, 2.0]) == Spread(median=2.5, low=1.0, high=8.0)
    assert speed_up(20.0, 5.0, less_is_better=False) == 4.0
    assert speed_up(20.0, 5.0, less_is_better=True) == 0.25
    assert [number(value) for value in (0, 0.01234, 1.5, 99.96, 12345.6)] == [
        *("0", "0.0123", "1.50", "100", "12,346")
    ]


def test_rate_counts_units_over_at_least_one_step() -> None:
    calls = []
    assert rate(lambda: calls.append(0) or 7, seconds=0.0) > 0
    assert len(calls) == 1


def test_scale_multiplies_work_alone_and_merges_equal_sizes() -> None:
    scaled = row(scaled=("batch",)).scaled_sizes(0.4)
    assert scaled == [{"batch": 1, "seconds": 1.0}]
    assert row().scaled_sizes(0.5) == [{"batch": batch, "seconds": 0.5} for batch in (1, 2, 3)]


def test_command_prints_and_merges_into_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "ROWS", (row("peer", "ours"),))
    output = tmp_path / "new" / "results.json"
    for repeats in (3, 1):
        assert command.main(["--rows=row", f"--repeats={repeats}", f"--output={output}"]) == 0
    results = json.loads(output.read_text())
    assert [(result["sizes"]["batch"], result["peer_name"]) for result in results] == [
        (batch, peer) for batch in (1, 2, 3) for peer in ("peer", "ours")
    ]
    assert {result["repeats"] for result in results} == {1}  # the second run's replaced the first's
    assert (
        results[0]["provenance"]["command"]
        == f"python -m benchmarks --rows=row --repeats=1 --output={output}"
    )
    assert {"torch", "CPU", "CPU cores"} <= results[0]["provenance"].keys()
    table = output.with_suffix(".md").read_text().splitlines()
    assert len(table) == 2 + len(results)
    cells = [cell.strip() for cell in table[2].split("|")[1:-1]]
    assert cells[0] == "row; steps/s"
    assert cells[2:] == ["peer", "10.0 [10.0, 10.0]", "5.00 [5.00, 5.00]", "2.00"]
    printed = capsys.readouterr().out
    assert "[4.00, 6.00]" in printed
    assert max(map(len, printed.splitlines())) <= 100


def test_command_goes_on_after_a_failure_and_reports_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "ROWS", (row("broken", scaled=("batch",)), row("peer")))
    output = tmp_path / "results.json"
    assert command.main(["--rows=row", "--repeats=1", f"--output={output}"]) == 3
    assert "no batch of 2 for you" in capsys.readouterr().out
    assert len(json.loads(output.read_text())) == 3


def test_measurements_of_another_processor_are_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "ROWS", (row("peer"),))
    output = tmp_path / "results.json"
    command.main(["--rows=row", "--repeats=1", f"--output={output}"])
    before = output.read_text()
    monkeypatch.setattr(command, "cpu_kind", lambda: "another")
    with pytest.raises(SystemExit, match=r"another.*--output"):
        command.main(["--rows=row", "--repeats=1", f"--output={output}"])
    assert output.read_text() == before


def test_list_names_every_row(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--list"]) == 0
    printed = capsys.readouterr().out
    assert all(row.name in printed for row in ROWS)


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--rows=windows,nothing", "nothing"),
        ("--scale=tiny", "'tiny'"),
    ],
)
def test_wrong_flags_are_refused(flag: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.parse_arguments([flag])
    assert message in capsys.readouterr().err


def test_every_side_exists_and_takes_its_rows_sizes() -> None:
    for each in ROWS:
        assert len(each.sizes) == 3
        for side in (each.ours, *each.peers):
            module, name = side.function.split(":")
            tree = ast.parse((ROOT / f"{module.replace('.', '/')}.py").read_text())
            [function] = [
                node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name
            ]
            names = [argument.arg for argument in function.args.args]
            assert names[0] == "folder", side
            assert set(each.sizes[0]) == set(names[1:]) or function.args.kwarg is not None, side
            assert side.environment == OWN or (PINS / f"{side.environment}.txt").is_file()


def test_peers_have_the_settings_of_our_policies() -> None:
    for config in (WMIQLConfig(device="cpu"), WMBCConfig(device="cpu")):
        assert config.hidden_dims == shared.HIDDEN_DIMS
        assert config.dropout == shared.DROPOUT
        assert config.lr == shared.LEARNING_RATE
    config = WMIQLConfig(device="cpu")
    assert (config.iql.beta, config.iql.expectile, config.iql.discount, config.iql.target_rate) == (
        *(shared.BETA, shared.EXPECTILE),
        *(shared.DISCOUNT, shared.TARGET_RATE),
    )


@pytest.mark.parametrize("peer", ["torchrl", "d3rlpy"])
def test_pins_leave_torch_to_the_project(peer: str) -> None:
    lines = (PINS / f"{peer}.txt").read_text().splitlines()
    names = [line.split("==")[0] for line in lines]
    assert peer in names
    assert not {"torch", "triton"} & set(names)
    assert all(line.count("==") == 1 for line in lines)


@pytest.mark.slow
def test_real_row_through_the_command_line(tmp_path: Path) -> None:
    output = tmp_path / "results.json"
    arguments = ["--rows=collection", "--scale=0.01", "--repeats=1", f"--output={output}"]
    subprocess.run([sys.executable, "-m", "benchmarks", *arguments], cwd=ROOT, check=True)
    [result] = json.loads(output.read_text())
    assert result["row"] == "collection"
    assert result["ours"] > 0
    assert result["sizes"] == {"episodes_per_task": 1, "workers": 2, "threads": 1}


def test_frames_are_read_from_ram_and_from_a_memory_map(tmp_path: Path) -> None:
    root = memory.make_dataset(tmp_path, gigabytes=0.01)
    speeds = memory.reading_speeds(root)
    assert {side: len(found) for side, found in speeds.items()} == dict.fromkeys(
        ("RAM", "warm", "cold"), memory.REPEATS
    )
    assert min(min(found) for found in speeds.values()) > 0

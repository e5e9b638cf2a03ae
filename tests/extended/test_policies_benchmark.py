"""`python -m benchmarks.policies`: how long it trains, what it compares, and one policy from start to table."""

import json
import sys
from pathlib import Path

import pytest

from benchmarks import policies
from benchmarks.policies import Task, ours
from tests.flags import SMALL_WORLD_MODEL
from tests.recording import camera, record, vector


def test_the_time_of_a_step_is_read_from_lerobots_log() -> None:
    log = (
        "step:10 loss:0.9 updt_s:9.5 data_s:3.0 smp/s:1\nstep:20 lr:3.0e-04 updt_s:0.133 data_s:0.007 smp/s:2"
    )
    assert policies.step_seconds(log) == pytest.approx(0.14)


def test_success_is_compared_start_by_start() -> None:
    won, lost = [True] * 30 + [False] * 20, [False] * 50
    assert policies.difference(won, won) == "+0 [+0, +0]"
    assert policies.difference(won, lost).startswith("+60 [+4")
    assert policies.difference(lost, won).startswith("-60 [-7")


def test_fewer_episodes_of_each_task_are_the_first_starts() -> None:
    two = [{"metrics": {"successes": [True, False]}}, {"metrics": {"successes": [False, True]}}]
    one = [{"metrics": {"successes": [True]}}, {"metrics": {"successes": [False]}}]
    assert policies.by_start(two, "successes") == [True, False, False, True]
    assert policies.by_start(one, "successes") == [True, False]


@pytest.mark.slow
def test_a_policy_is_trained_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("gym_pusht", reason="scripts/setup.sh installs it")
    features = {
        "observation.image": camera(96, 96),
        "observation.state": vector(2),
        "action": vector(2),
    }
    root = tmp_path / "demonstrations"
    record(root, features, [("Push", policies.LATENCY_FRAMES)])
    world_model = f"{SMALL_WORLD_MODEL} --policy.window_length=4"
    task = Task("--env.type=pusht --env.episode_length=3", {"wm_bc": ours(0.5, world_model, "")})
    monkeypatch.setattr(policies, "TASKS", {"toy": task})
    arguments = (
        f"--task=toy --root={root} --minutes=0.01 --policies=wm_bc --episodes=2 --output_dir={tmp_path}"
    )
    monkeypatch.setattr(sys, "argv", ["policies", *arguments.split()])
    policies.main()

    row = json.loads((tmp_path / "wm_bc.json").read_text())
    assert len(row["successes"]) == len(row["max_rewards"]) == 2
    assert row["memory_gb"] > 0.1
    assert "--steps=1 " in row["trainings"][1]["command"]
    assert "wm_bc" in capsys.readouterr().out
    policies.main()  # reads what is there

"""Ctrl-C: one line that says how to go on, no traceback, no process left, and the same command goes on."""

from pathlib import Path

import pytest
from lerobot.utils.io_utils import load_json

from lerobot_wm.data.source import open_dataset
from lerobot_wm.records import read_records
from tests.extended.faults.running import Commands, Ended, Inputs

TRAINED = "training_state/training_step.json"


def check_interrupted(ended: Ended) -> None:
    assert ended.code == 130, ended.printed
    assert "Traceback" not in ended.printed
    assert "interrupted" in ended.last_line


@pytest.mark.parametrize("name", ["collect", "encode", "eval"])
def test_the_same_command_goes_on(name: str, processes: Commands, inputs: Inputs, tmp_path: Path) -> None:
    output = tmp_path / "output"
    begun = {"collect": "output.shards/*.part/*", "encode": "output.parts", "eval": "output/*.part"}[name]
    result = {"collect": "meta/info.json", "encode": "meta/info.json", "eval": "records.jsonl"}[name]
    command = inputs.command(name, output)
    ended = processes.start(command).interrupt_when(lambda: list(tmp_path.glob(begun)))
    check_interrupted(ended)
    assert ended.last_line.startswith(f"lerobot-wm {name}: ")
    assert not (output / result).exists()
    assert not list(tmp_path.glob(".*")), "the lock is gone"

    again = processes.run(command)
    assert again.code == 0, again.printed
    if name == "eval":
        assert [record["variation"] for record in read_records([output / result])] == [0, 1]
        assert not list(output.glob("*.part"))
    else:
        open_dataset("a/b", output)
        assert {path.name for path in tmp_path.iterdir()} <= {"output", "output.cache"}


def test_training_says_how_to_go_on(processes: Commands, inputs: Inputs, tmp_path: Path) -> None:
    run = tmp_path / "run"
    last = run / "checkpoints" / "last"
    work = processes.start(inputs.command("train", run), "--steps=3000")
    ended = work.interrupt_when(last.exists)
    check_interrupted(ended)
    _, advice, _ = ended.last_line.split("`")
    assert advice == (
        f"lerobot-wm train --config_path={last}/pretrained_model/train_config.json --resume=true"
    )
    step = load_json(last / TRAINED)["step"]
    again = processes.run(advice.removeprefix("lerobot-wm "), f"--steps={step + 2}")
    assert again.code == 0, again.printed
    assert load_json(last / TRAINED)["step"] == step + 2


def test_before_the_first_checkpoint(processes: Commands, inputs: Inputs, tmp_path: Path) -> None:
    command = f"{inputs.command('train', tmp_path / 'run')} --steps=3000 --save_freq=3000"
    ended = processes.start(command).interrupt_when((tmp_path / "run" / "train_log.jsonl").exists)
    check_interrupted(ended)
    assert f"remove {tmp_path / 'run'}" in ended.last_line
    refused = processes.run(command)
    assert refused.code == 1
    assert str(tmp_path / "run") in refused.last_line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "begun"), [("collect", "output.shards/*.part/*"), ("eval", "output/*.part")]
)
def test_workers_end_too(name: str, begun: str, processes: Commands, inputs: Inputs, tmp_path: Path) -> None:
    command = inputs.command(name, tmp_path / "output", workers=2)
    ended = processes.start(command).interrupt_when(lambda: list(tmp_path.glob(begun)))
    check_interrupted(ended)
    assert not [path for path in tmp_path.glob("output.shards/*") if path.suffix != ".part"], (
        "no worker finished what it had begun"
    )
    again = processes.run(command)
    assert again.code == 0, again.printed


def test_the_expert_and_its_workers_end(processes: Commands, tmp_path: Path) -> None:
    command = f"expert --tasks=reach-v3,window-close-v3 --num_workers=2 --output_dir={tmp_path / 'output'}"
    work = processes.start(command)
    ended = work.interrupt_when(lambda: len(work.processes) >= 3)
    check_interrupted(ended)
    assert not list(tmp_path.rglob("records.jsonl*"))

"""Training in two processes: disjoint samples, the loss curve of one process, files made once."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.loader import RamDataset
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from tests.extended.noting import noting
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS

BATCH = 16  # of each of two processes; one process has twice as much


def lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def losses(run_folder: Path) -> list[float]:
    return [line["loss"] for line in lines(run_folder / "train_log.jsonl")]


def train_in_two(notes: Path, *arguments: str) -> str:
    """`lerobot-wm train ARGUMENTS` in two processes; what they print. They note the rows they read in `notes`."""
    notes.mkdir()
    script = Path(__file__).with_name("noting.py")
    run = subprocess.run(
        [
            *(sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"),
            *(str(script), "train", *" ".join(arguments).split()),
        ],
        env={**os.environ, "NOTES": str(notes), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert run.returncode == 0, run.stderr
    return run.stderr


def test_two_processes_train_as_one_with_twice_the_batch(
    demos_root: Path,
    world_model_path: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    demos, one, two = tmp_path / "demos", tmp_path / "one", tmp_path / "two"
    shutil.copytree(demos_root, demos)  # without its cache: nothing is decoded or encoded yet
    dataset = LeRobotDataset("test/demos", root=demos)
    epoch = -(-dataset.num_frames // (2 * BATCH))  # steps
    flags = (
        f"--policy.type=wm_bc --policy.world_model_path={world_model_path} --policy.dropout=0 --policy.dtype=float32",
        f"--steps={epoch + 2} --log_freq=1 {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos)}",
    )
    printed = train_in_two(two, *flags, f"--batch_size={BATCH} --output_dir={two / 'run'}")
    one.mkdir()
    monkeypatch.setattr(RamDataset, "batch", noting(RamDataset.batch, one / "rows"))
    lerobot_wm_command("train", *flags, f"--batch_size={2 * BATCH} --output_dir={one / 'run'}")

    alone = lines(one / "rows")
    together = [a + b for a, b in zip(lines(two / "rows-0"), lines(two / "rows-1"), strict=True)]
    last = epoch - 1
    full_steps = [*range(last), epoch, epoch + 1]
    assert [together[step] for step in full_steps] == [alone[step] for step in full_steps]
    # An epoch's last step is filled up with the epoch's first rows.
    rest = alone[last]
    assert together[last] == rest + alone[0][: 2 * BATCH - len(rest)]
    assert sorted(row for rows in alone[:epoch] for row in rows) == list(range(dataset.num_frames))

    assert len(losses(two / "run")) == epoch + 2
    assert losses(two / "run")[:last] == pytest.approx(losses(one / "run")[:last], rel=1e-5)
    assert printed.count("Checkpoint policy after") == 1
    WMBCPolicy.from_pretrained(two / "run" / "checkpoints" / "last" / "pretrained_model")

    # One process decoded and encoded, the other found it done.
    assert sorted(lines(two / "decoded-0")) == list(range(dataset.num_episodes))
    assert not (two / "decoded-1").exists()


@pytest.mark.slow
def test_world_model_in_two_processes(
    demos_root: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    flags = (
        "--policy.type=wm_rssm --policy.window_length=8 --policy.dtype=float32 --policy.lr=1e-4 --steps=8 --log_freq=1",
        f"{TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)}",
    )
    train_in_two(tmp_path / "two", *flags, f"--batch_size=4 --output_dir={tmp_path / 'two' / 'run'}")
    lerobot_wm_command("train", *flags, f"--batch_size=8 --output_dir={tmp_path / 'one'}")
    # Both processes draw the same noise for z, one process draws twice as much: the curves agree but for that.
    assert losses(tmp_path / "two" / "run") == pytest.approx(losses(tmp_path / "one"), rel=0.01)

"""Reports that take a world model or the tools of LeRobot to repeat."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.latents import LatentRecord
from lerobot_wm.data.source import open_dataset
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS


def edit(latents_root: Path, output: Path, operation: str) -> None:
    """Run `lerobot-edit-dataset` on latents."""
    tool = Path(sys.executable).with_name("lerobot-edit-dataset")
    places = ["--repo_id=test/latents", f"--root={latents_root}", f"--new_root={output}"]
    run = subprocess.run(
        [tool, *places, "--new_repo_id=test/edited", *operation.split(maxsplit=1)],
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr


def test_latents_without_some_episodes(latents_root: Path, tmp_path: Path) -> None:
    edit(
        latents_root,
        tmp_path / "edited",
        "--operation.type=delete_episodes --operation.episode_indices=[0,1]",
    )
    assert open_dataset("test/edited", tmp_path / "edited").total_episodes == 6
    # The record of the world model is not copied, and the advice does not ask to encode what has no images.
    with pytest.raises(ValueError, match=r"latents\.json.*lerobot-edit-dataset"):
        LatentRecord.read(tmp_path / "edited")


def test_latents_that_are_split(latents_root: Path, tmp_path: Path) -> None:
    edit(
        latents_root,
        tmp_path / "split",
        '--operation.type=split --operation.splits={"train":[0,1,2],"val":[3,4]}',
    )
    sizes = {json.loads(path.read_text())["total_episodes"] for path in tmp_path.rglob("info.json")}
    assert sizes == {3, 2}


def test_an_environment_that_a_policy_on_latents_cannot_act_in_is_found_before_encoding(
    demos: LeRobotDataset, world_model_path: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    with pytest.raises(ValueError, match="drawer"):
        lerobot_wm_command(
            f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --steps=2 {TRAIN_FLAGS}",
            "--env.type=metaworld_mt --env.task=drawer-open-v3",
            f"{DATASET_FLAGS.format(root=demos.root)} --output_dir={tmp_path / 'run'}",
        )
    assert not list(Path(demos.root).parent.glob("*.cache/latents-*"))

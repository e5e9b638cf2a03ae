"""LeRobot's own tools on a collected dataset, called as a user calls them."""

import subprocess
import sys
from pathlib import Path

import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.collect.command import CollectConfig, collect

ACT = (
    "--policy.type=act",
    "--policy.push_to_hub=false",
    "--policy.device=cpu",
    "--policy.dim_model=32",
    "--policy.n_heads=2",
    "--policy.dim_feedforward=32",
    "--policy.n_encoder_layers=1",
    "--policy.n_vae_encoder_layers=1",
    "--policy.chunk_size=8",
    "--policy.n_action_steps=8",
    "--policy.pretrained_backbone_weights=null",
    "--policy.latent_dim=8",
    "--steps=2",
    "--batch_size=4",
    "--num_workers=0",
    "--save_freq=2",
    "--log_freq=1",
    "--env_eval_freq=0",
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tools") / "dataset"
    return collect(
        CollectConfig(repo_id="user/x", root=folder, tasks="reach-v3", episodes_per_task=3, num_workers=1)
    )


def run(module: str, *flags: str) -> None:
    result = subprocess.run([sys.executable, "-m", module, *flags], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_edit_dataset_deletes_an_episode(root: Path, tmp_path: Path) -> None:
    edited = tmp_path / "edited"
    run(
        "lerobot.scripts.lerobot_edit_dataset",
        *("--repo_id=user/x", f"--root={root}", "--new_repo_id=user/y", f"--new_root={edited}"),
        *("--operation.type=delete_episodes", "--operation.episode_indices=[1]"),
    )
    before, after = LeRobotDataset("user/x", root=root), LeRobotDataset("user/y", root=edited)
    assert after.num_episodes == 2
    lengths = before.meta.episodes["length"]
    assert list(after.meta.episodes["length"]) == [lengths[0], lengths[2]]
    assert after.meta.features[key := "observation.image"]["shape"] == before.meta.features[key]["shape"]


@pytest.mark.slow
def test_act_trains(root: Path, tmp_path: Path) -> None:
    output = tmp_path / "act"
    run(
        "lerobot.scripts.lerobot_train",
        *("--dataset.repo_id=user/x", f"--dataset.root={root}", f"--output_dir={output}", *ACT),
    )
    assert (output / "checkpoints" / "000002" / "pretrained_model" / "model.safetensors").exists()

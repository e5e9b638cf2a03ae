"""`lerobot-wm init`: an untrained world model that stands where a trained one stands."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from safetensors.torch import load_file

from lerobot_wm.data.latents import LatentRecord
from lerobot_wm.policies.latent.policy import load_encoder
from tests.flags import DATASET_FLAGS


@pytest.fixture(scope="module")
def untrained_path(
    demos_root: Path, tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Callable[..., None]
) -> Path:
    folder = tmp_path_factory.mktemp("init")
    lerobot_wm_command(
        "init --policy.type=wm_rssm --policy.device=cpu --policy.rssm.deter_dim=32 --seed=5",
        DATASET_FLAGS.format(root=demos_root),
        f"--output_dir={folder}",
    )
    return folder / "pretrained_model"


def test_scalings_are_the_datasets(untrained_path: Path, demos: LeRobotDataset) -> None:
    policy = load_encoder(str(untrained_path))
    stats = demos.meta.stats["action"]
    actions = torch.from_numpy(np.stack([stats["min"], stats["max"]])).float()
    scaled = policy.world_model.action_scaling(actions)
    constant = actions[0] == actions[1]  # the gripper's command, in each of these tasks
    torch.testing.assert_close(scaled[:, ~constant], torch.tensor([[-1.0], [1.0]]).expand(2, 4)[:, ~constant])
    make_pre_post_processors(policy.config, pretrained_path=str(untrained_path))


def test_it_encodes_as_a_trained_one(
    untrained_path: Path, demos_root: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    lerobot_wm_command(
        f"encode --world_model_path={untrained_path} --device=cpu --output_repo_id=test/untrained",
        DATASET_FLAGS.format(root=demos_root),
        f"--output_root={tmp_path / 'latents'}",
    )
    assert LatentRecord.read(tmp_path / "latents").source_repo_id == "test/demos"
    encoded = LeRobotDataset("test/untrained", root=tmp_path / "latents")
    assert encoded.meta.features["observation.latent"]["shape"] == (32 + 256,)


def test_seed_decides_the_weights(
    untrained_path: Path, demos_root: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    weights = [load_file(untrained_path / "model.safetensors")]
    for seed in (5, 6):
        lerobot_wm_command(
            f"init --policy.type=wm_rssm --policy.device=cpu --policy.rssm.deter_dim=32 --seed={seed}",
            DATASET_FLAGS.format(root=demos_root),
            f"--output_dir={tmp_path / str(seed)}",
        )
        weights.append(load_file(tmp_path / str(seed) / "pretrained_model" / "model.safetensors"))
    key = "world_model.encoder.layers.0.weight"
    assert torch.equal(weights[0][key], weights[1][key])
    assert not torch.equal(weights[0][key], weights[2][key])


def test_a_checkpoint_is_never_overwritten(
    untrained_path: Path, demos_root: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    with pytest.raises(FileExistsError, match="pretrained_model"):
        lerobot_wm_command(
            "init --policy.type=wm_rssm",
            DATASET_FLAGS.format(root=demos_root),
            f"--output_dir={untrained_path.parent}",
        )

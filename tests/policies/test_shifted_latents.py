"""Policies that are trained on latents of randomly shifted images."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from tests.recording import train_flags

LATENT, SHIFTED = "observation.latent", "observation.shifted_latents"
COPIES = 8


@pytest.fixture(scope="module")
def run(
    demos: LeRobotDataset,
    world_model_path: Path,
    lerobot_wm_command: Callable[..., None],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    folder = tmp_path_factory.mktemp("shifted") / "run"
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --policy.random_crop_pad=2",
        f"--policy.dropout=0 --steps=2 --save_freq=2 --batch_size=8 {train_flags(demos)} --output_dir={folder}",
    )
    return folder / "checkpoints" / "last" / "pretrained_model"


@pytest.fixture(scope="module")
def shifted(
    demos: LeRobotDataset,
    world_model_path: Path,
    lerobot_wm_command: Callable[..., None],
    tmp_path_factory: pytest.TempPathFactory,
) -> LeRobotDataset:
    root = tmp_path_factory.mktemp("shifted") / "latents"
    lerobot_wm_command(
        f"encode --world_model_path={world_model_path} --random_crop_pad=2 --device=cpu --output_root={root}",
        f"--dataset.repo_id=test/demos --dataset.root={demos.root} --output_repo_id=test/shifted",
    )
    return LeRobotDataset("test/shifted", root=root)


def test_images_are_also_encoded_with_random_shifts(shifted: LeRobotDataset, latents_root: Path) -> None:
    latents, copies = (torch.stack(shifted.hf_dataset[key][:]) for key in (LATENT, SHIFTED))
    assert copies.shape == (len(latents), COPIES, latents.shape[1])
    plain = torch.stack(LeRobotDataset("test/latents", root=latents_root).hf_dataset[LATENT][:])
    torch.testing.assert_close(latents, plain)
    distance = (copies - latents[:, None]).norm(dim=-1)  # (N, K)
    assert (distance > 0).float().mean() > 0.8  # one shift in 25 is none
    assert distance.mean() < torch.pdist(latents).mean()  # a shifted image resembles itself more than others


def test_training_draws_from_the_shifted_images_and_evaluation_does_not(
    run: Path, shifted: LeRobotDataset
) -> None:
    policy = WMBCPolicy.from_pretrained(run)
    item = {
        key: value[None] if isinstance(value, torch.Tensor) else [value] for key, value in shifted[0].items()
    }
    tasks = policy.one_hot_tasks(item, 1)
    size = policy.config.latent_dim

    def read() -> torch.Tensor:
        return policy.observation_at(item, tasks)[0, :size]

    policy.train()
    copies = item[SHIFTED][0]
    drawn = torch.cdist(
        torch.stack([read() for _ in range(100)]), copies, compute_mode="donot_use_mm_for_euclid_dist"
    )
    assert (drawn.amin(1) == 0).all()
    assert drawn.argmin(1).unique().numel() > COPIES / 2  # some have the same shift
    policy.eval()
    torch.testing.assert_close(read(), item[LATENT][0])


def test_latents_without_shifts_are_refused(
    latents_root: Path, world_model_path: Path, lerobot_wm_command: Callable[..., None], tmp_path: Path
) -> None:
    latents = LeRobotDataset("test/latents", root=latents_root)
    with pytest.raises(ValueError, match="random_crop_pad=2, but its latents were encoded with"):
        lerobot_wm_command(
            f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --policy.random_crop_pad=2",
            f"--steps=1 {train_flags(latents)} --output_dir={tmp_path / 'run'}",
        )

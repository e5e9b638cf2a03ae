"""`wm_bc` that trains its world model with the head."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.cache import CACHE_VARIABLE
from lerobot_wm.policies.latent.policy import load_encoder
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from tests.flags import TRAIN_FLAGS
from tests.recording import train_flags

LENGTH, CHUNK = 6, 3


@pytest.fixture(scope="module")
def run(
    demos: LeRobotDataset,
    world_model_path: Path,
    lerobot_wm_command: Callable[..., None],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """A run of two steps, resumed for two more."""
    folder = tmp_path_factory.mktemp("finetune")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(CACHE_VARIABLE, str(folder / "cache"))
        lerobot_wm_command(
            f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --steps=2 --save_freq=2",
            f"--policy.finetune_world_model=true --policy.window_length={LENGTH} --policy.chunk_size={CHUNK}",
            f"--policy.random_crop_pad=2 --batch_size=4 --policy.lr=0.001 {train_flags(demos)}",
            f"--output_dir={folder / 'run'}",
        )
        config = folder / "run" / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
        lerobot_wm_command(f"train --config_path={config} --resume=true --steps=4")
    return folder


def load(run: Path) -> WMBCPolicy:
    return WMBCPolicy.from_pretrained(run / "run" / "checkpoints" / "last" / "pretrained_model")


def test_encoder_and_filter_learn_from_images_alone(run: Path, world_model_path: Path) -> None:
    assert not list((run / "cache").rglob("latents-*"))
    before = load_encoder(str(world_model_path)).world_model.state_dict()
    after = load(run).world_model.state_dict()
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"encoder", "rssm"}


def test_the_loss_is_that_of_the_frames_on_the_latents_of_the_filter(
    run: Path, demos: LeRobotDataset
) -> None:
    policy = load(run)
    items = [demos[t] for t in range(LENGTH + CHUNK - 1)]
    action = torch.stack([item["action"] for item in items])  # (T + K - 1, A)
    windows: dict[str, Any] = {
        key: torch.stack([item[key] for item in items[:LENGTH]])[None]
        for key in ("observation.image", "observation.state")
    }
    windows |= {"action": action[None], "task": [items[0]["task"]]}
    windows["action_is_pad"] = torch.zeros(1, len(action), dtype=torch.bool)
    loss, _ = policy.forward(windows)

    with torch.no_grad():
        latents = policy.world_model.filter(
            windows["observation.image"], windows["action"][:, :LENGTH]
        ).latent[0]
    frames = {
        "observation.latent": latents,
        "observation.state": windows["observation.state"][0],
        "action": torch.stack([action[t : t + CHUNK] for t in range(LENGTH)]),
        "task": windows["task"] * LENGTH,
    }
    policy.config.finetune_world_model = False
    torch.testing.assert_close(policy.forward(frames)[0], loss)

    policy.config.finetune_world_model = True
    windows["action_is_pad"][:, 4:] = True  # the episode ends within the window
    short, _ = policy.forward(windows)
    windows["action"][:, 4:] = 9.0
    torch.testing.assert_close(policy.forward(windows)[0], short)


def test_it_acts_on_the_fine_tuned_filter(run: Path, demos: LeRobotDataset) -> None:
    policy = load(run)
    items = [demos[t] for t in range(4)]
    keys = ("observation.image", "observation.state")
    batches = [{key: item[key][None] for key in keys} | {"task": [item["task"]]} for item in items]
    actions = torch.stack([policy.select_action(batch) for batch in batches], dim=1)  # (1, 4, A)
    policy.reset()
    for batch, action in zip(batches[:3], actions.unbind(1), strict=False):
        policy.predict_action_chunk(batch)
        policy.executed(action)
    images = torch.stack([item["observation.image"] for item in items])[None]
    with torch.no_grad():
        latent = policy.world_model.filter(images, actions).latent[:, 3]  # (1, L)
        state, tasks = batches[3]["observation.state"], policy.one_hot_tasks(batches[3], 1)
        expected = policy.act(policy.observation(state, tasks, latent), state)
    torch.testing.assert_close(policy.predict_action_chunk(batches[3])[:, 0], expected, atol=1e-4, rtol=1e-4)


def test_a_policy_without_a_world_model_has_none_to_train() -> None:
    with pytest.raises(ValueError, match="use_latent"):
        WMBCConfig(device="cpu", finetune_world_model=True, use_latent=False)


@pytest.mark.parametrize(
    ("flag", "named"),
    [
        ({"random_crop_pad": -1, "finetune_world_model": True}, "random_crop_pad=-1"),
        ({"window_length": 0, "finetune_world_model": True}, "window_length=0"),
    ],
)
def test_flags_without_effect_or_meaning_are_refused(flag: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        WMBCConfig(device="cpu", **flag)


def test_latents_and_frozen_backbones_cannot_be_fine_tuned(
    demos: LeRobotDataset,
    latents_root: Path,
    world_model_path: Path,
    lerobot_wm_command: Callable[..., None],
    tmp_path: Path,
) -> None:
    backbone = tmp_path / "backbone"
    data = f"--dataset.repo_id=test/demos --dataset.root={demos.root}"
    lerobot_wm_command(
        f"init --policy.type=frozen_backbone --policy.device=cpu {data} --output_dir={backbone}"
    )
    train = "train --policy.type=wm_bc --policy.finetune_world_model=true --steps=1"
    with pytest.raises(ValueError, match="test/latents"):
        lerobot_wm_command(
            f"{train} --policy.world_model_path={world_model_path} --output_dir={tmp_path / 'run'}",
            f"{TRAIN_FLAGS} --dataset.repo_id=test/latents --dataset.root={latents_root}",
        )
    with pytest.raises(ValueError, match="frozen_backbone"):
        lerobot_wm_command(
            f"{train} --policy.world_model_path={backbone / 'pretrained_model'} --output_dir={tmp_path / 'run'}",
            train_flags(demos),
        )

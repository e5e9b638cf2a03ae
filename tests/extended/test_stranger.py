"""A dataset this project knows nothing of, from training to actions, by the commands a user gives and no code.

Two cameras of different sizes, 9-d state, 7-d action, no reward, three tasks, episodes of 10 to 300 frames.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file
from torch.utils.data import DataLoader

from lerobot_wm.data.loader import RamLoader
from lerobot_wm.nn.images import camera_images
from lerobot_wm.policies.e2e_bc.modeling_e2e_bc import E2EBCPolicy
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from tests.flags import SMALL_WORLD_MODEL, TRAIN_FLAGS
from tests.recording import FRAME_SHAPES, FRONT, WRIST, record_stranger, train_flags

Command = Callable[..., None]
CHECKPOINT = Path("checkpoints", "last", "pretrained_model")
TASKS = ["Pick up the cup", "Open the lid", "Wave"]
LENGTHS = (10, 300, 40)
# Twelve frames a window: longer than the first episode.
WORLD_MODEL = f"{SMALL_WORLD_MODEL} --policy.window_length=12 --steps=3 --batch_size=2 --log_freq=1"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    return record_stranger(tmp_path_factory.mktemp("stranger") / "dataset", lengths=LENGTHS)


@pytest.fixture(scope="module")
def flags(dataset: LeRobotDataset) -> str:
    return train_flags(dataset)


@pytest.fixture(scope="module")
def world_model_path(
    flags: str, tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Command
) -> Path:
    run = tmp_path_factory.mktemp("world_model") / "run"
    lerobot_wm_command(f"train --policy.type=wm_rssm {WORLD_MODEL} {flags} --output_dir={run}")
    return run / CHECKPOINT


@pytest.fixture(scope="module")
def policy_path(
    flags: str, world_model_path: Path, tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Command
) -> Path:
    run = tmp_path_factory.mktemp("policy") / "run"
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --steps=3 --batch_size=8",
        f"{flags} --output_dir={run}",
    )
    return run / CHECKPOINT


def frame(dataset: LeRobotDataset, index: int) -> dict:
    """What a robot shows: images as the cameras give them."""
    item = dataset[index]
    keys = (FRONT, WRIST, "observation.state")
    return {**{key: item[key][None] for key in keys}, "task": [item["task"]]}


def test_a_world_model_learns_from_it(world_model_path: Path) -> None:
    policy = WMRSSMPolicy.from_pretrained(world_model_path)
    assert policy.config.cameras == [FRONT, WRIST]
    assert policy.config.rssm.image_channels == 6
    assert policy.config.rssm.action_dim == 7
    assert not policy.config.rssm.predict_reward
    assert not [name for name in policy.state_dict() if "reward" in name]


@torch.no_grad()
def test_the_policy_sees_on_the_robot_what_it_was_trained_on(
    dataset: LeRobotDataset, policy_path: Path
) -> None:
    """Frames of the cameras' own sizes give the latents that were encoded from resized ones, in every episode."""
    policy = WMBCPolicy.from_pretrained(policy_path)
    assert policy.config.tasks == TASKS
    [root] = Path(dataset.root).with_name("dataset.cache").glob("latents-*")
    encoded = LeRobotDataset("test/latents", root=root)
    for episode in range(3):
        start = dataset.meta.episodes[episode]["dataset_from_index"]
        policy.reset()
        for index in range(start, start + 10):
            action = policy.select_action(frame(dataset, index))
            assert action.shape == (1, 7)
            stored = encoded[index]["observation.latent"]
            torch.testing.assert_close(policy._filter_state.latent[0], stored, atol=2e-5, rtol=2e-5)
            policy._prev_action = dataset[index]["action"][None]


@pytest.mark.parametrize("dtype", ["image", "video"])
def test_both_loaders_show_a_model_the_same_images(
    dtype: str, world_model_path: Path, tmp_path: Path
) -> None:
    """Bit for bit, though one resizes in the policy and the other did so when it decoded."""
    config = WMRSSMPolicy.from_pretrained(world_model_path).config
    root = record_stranger(tmp_path / "dataset", dtype, lengths=(10, 80)).root
    windows = {key: [0.0, 0.1] for key in (FRONT, WRIST)}
    source = LeRobotDataset("test/recorded", root=root, delta_timestamps=windows, return_uint8=True)
    loader = DataLoader(source, batch_size=3, sampler=[0, 9, 85])
    cameras = dict.fromkeys(config.cameras, config.image_size)
    [theirs], [ours] = loader, RamLoader(loader, loader.batch_sampler, torch.device("cpu"), cameras)
    for key, (height, width, _) in FRAME_SHAPES.items():
        assert theirs[key].shape == (3, 2, 3, height, width)
        assert ours[key].shape == (3, 2, 3, 64, 64)
    seen = []
    for batch in (theirs, ours):
        # LeRobot's training loop turns the uint8 of videos into numbers from 0 to 1; images are that already.
        as_float = {key: batch[key] if dtype == "image" else batch[key].float() / 255 for key in FRAME_SHAPES}
        seen.append(camera_images(as_float, config.cameras, config.image_size))
    assert seen[0].std() > 0.1
    assert torch.equal(*seen)


def test_frames_are_stored_at_the_models_size_alone(dataset: LeRobotDataset, policy_path: Path) -> None:
    cache = Path(dataset.root).with_name("dataset.cache")
    sizes = {path.name: path.stat().st_size for path in cache.glob("frames-*/*.npy")}
    for key in FRAME_SHAPES:
        assert f"{key}.npy" not in sizes
        assert 0 < sizes[f"{key}-64x64.npy"] - sum(LENGTHS) * 64 * 64 * 3 < 1000


def test_plain_lerobot_commands(
    flags: str,
    dataset: LeRobotDataset,
    tmp_path: Path,
    lerobot_wm_command: Command,
    lerobot_train_command: Command,
) -> None:
    world_model, latents = tmp_path / "world_model" / CHECKPOINT, tmp_path / "latents"
    lerobot_train_command(
        f"--policy.type=wm_rssm {WORLD_MODEL} {flags} --output_dir={tmp_path / 'world_model'}"
    )
    lerobot_wm_command(
        f"encode --world_model_path={world_model} --device=cpu --dataset.repo_id=test/recorded",
        f"--dataset.root={dataset.root} --output_repo_id=test/latents --output_root={latents}",
    )
    lerobot_train_command(
        f"--policy.type=wm_bc --policy.world_model_path={world_model} --steps=2 --batch_size=8 {TRAIN_FLAGS} "
        f"--dataset.repo_id=test/latents --dataset.root={latents} --output_dir={tmp_path / 'policy'}"
    )
    policy = WMBCPolicy.from_pretrained(tmp_path / "policy" / CHECKPOINT)
    assert policy.select_action(frame(dataset, 0)).shape == (1, 7)


def test_end_to_end_policies_of_both_commands_are_equal(
    flags: str,
    dataset: LeRobotDataset,
    tmp_path: Path,
    lerobot_wm_command: Command,
    lerobot_train_command: Command,
) -> None:
    # Without dropout: LeRobot's loader draws from the generator that dropout masks come from, ours does not.
    run = (
        "--policy.type=e2e_bc --policy.encoder_image_size=[32,40] --policy.dtype=float32 --policy.dropout=0 "
        f"--steps=2 --batch_size=4 {flags} --output_dir={tmp_path}"
    )
    lerobot_train_command(f"{run}/theirs")
    lerobot_wm_command(f"train {run}/ours")
    theirs, ours = (
        load_file(tmp_path / name / CHECKPOINT / "model.safetensors") for name in ("theirs", "ours")
    )
    for name, tensor in theirs.items():
        torch.testing.assert_close(ours[name], tensor, msg=name)
    policy = E2EBCPolicy.from_pretrained(tmp_path / "ours" / CHECKPOINT)
    assert policy.config.image_shape == (6, 32, 40)
    assert policy.select_action(frame(dataset, 0)).shape == (1, 7)


def test_one_camera_chosen_by_flag(flags: str, tmp_path: Path, lerobot_wm_command: Command) -> None:
    lerobot_wm_command(
        f"train --policy.type=wm_rssm --policy.image_key={WRIST} {WORLD_MODEL} {flags} --output_dir={tmp_path / 'run'}"
    )
    policy = WMRSSMPolicy.from_pretrained(tmp_path / "run" / CHECKPOINT)
    assert policy.config.rssm.image_channels == 3
    assert policy.config.cameras == [WRIST]


def test_one_task_needs_no_task_string(tmp_path: Path, lerobot_wm_command: Command) -> None:
    dataset = record_stranger(tmp_path / "dataset", lengths=(12,))
    flags = train_flags(dataset)
    lerobot_wm_command(
        f"train --policy.type=wm_rssm {WORLD_MODEL} {flags} --output_dir={tmp_path / 'world_model'}"
    )
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={tmp_path / 'world_model' / CHECKPOINT}",
        f"--steps=2 --batch_size=8 {flags} --output_dir={tmp_path / 'policy'}",
    )
    policy = WMBCPolicy.from_pretrained(tmp_path / "policy" / CHECKPOINT)
    shown = frame(dataset, 0)
    with_string = policy.select_action(shown)
    policy.reset()
    del shown["task"]
    assert torch.equal(policy.select_action(shown), with_string)


@pytest.mark.parametrize("policy_type", ["wm_iql", "e2e_iql"])
def test_learning_from_rewards_needs_rewards(
    policy_type: str, flags: str, world_model_path: Path, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    extra = f"--policy.world_model_path={world_model_path}" if policy_type == "wm_iql" else ""
    bc = policy_type.replace("iql", "bc")
    with pytest.raises(ValueError, match=rf"no next\.reward.*--policy\.type={bc}, which needs none"):
        lerobot_wm_command(
            f"train --policy.type={policy_type} {extra} --steps=1 {flags} --output_dir={tmp_path / 'run'}"
        )

"""A dataset of the schema of LeRobot's public Meta-World data, as far as it is unlike ours.

PNG images of 480x480, a dense next.reward, next.success, and no next.done: the sparse reward is a policy option.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.utils.feature_utils import dataset_to_policy_features
from safetensors.torch import load_file

from lerobot_wm.policies.common.iql import FrameColumn, IQLConfig, RewardsAndEnds
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from tests.flags import SMALL_WORLD_MODEL
from tests.recording import FRONT, camera, record, train_flags, vector

Command = Callable[..., None]
CHECKPOINT = Path("checkpoints", "last", "pretrained_model")
TASKS = ["Reach a goal position", "Push and close a window"]
LENGTHS = (7, 5, 6)
SUCCESS_REWARD = "--policy.reward_key=next.success"


def labels(t: int, length: int) -> dict[str, Any]:
    """Dense rewards that grow, and success at the last frame."""
    return {
        "next.reward": torch.tensor([1.0 + t]).numpy(),
        "next.success": torch.tensor([t == length - 1]).numpy(),
        "task_id": torch.tensor([3], dtype=torch.int16).numpy(),
    }


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    features = {
        "observation.image": camera(480, 480),
        "observation.state": vector(4),
        "action": vector(4),
        "observation.environment_state": vector(39),
        "next.reward": vector(1),
        "next.success": vector(1, "bool"),
        "task_id": vector(1, "int16"),
    }
    episodes = [(TASKS[i % 2], length) for i, length in enumerate(LENGTHS)]
    return record(tmp_path_factory.mktemp("public") / "dataset", features, episodes, labels, fps=80)


@pytest.fixture(scope="module")
def flags(dataset: LeRobotDataset) -> str:
    return train_flags(dataset)


@pytest.fixture(scope="module")
def world_model_path(
    flags: str, tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Command
) -> Path:
    run = tmp_path_factory.mktemp("world_model") / "run"
    lerobot_wm_command(
        f"train --policy.type=wm_rssm {SMALL_WORLD_MODEL} {SUCCESS_REWARD} --policy.window_length=6",
        f"--steps=2 --batch_size=3 --log_freq=1 {flags} --output_dir={run}",
    )
    return run / CHECKPOINT


def test_labels_of_frames_are_found_by_index(dataset: LeRobotDataset) -> None:
    success = FrameColumn("next.success", dataset.meta)
    expected = torch.tensor([0.0] * 6 + [1] + [0] * 4 + [1] + [0] * 5 + [1])
    assert torch.equal(success.values, expected)
    assert not success.state_dict()
    index = torch.tensor([5, 0, 16])
    assert success({"index": index}, 3).tolist() == [[0, 1, 0], [0, 0, 0], [0, 1, 1]]
    assert FrameColumn("next.reward", dataset.meta)({"next.reward": index}) is index


def test_outcomes_of_sparse_and_dense_reward(dataset: LeRobotDataset) -> None:
    """Without next.done a task ends at success, whichever the reward."""
    batch = {"index": torch.tensor([0, 6, 8]), "next.reward": torch.tensor([1.0, 7.0, 2.0])}
    batch["observation.state_is_pad"] = torch.tensor([[False, False], [False, True], [False, False]])
    for key, expected in (("next.success", [0, 1, 0]), ("next.reward", [1, 7, 2])):
        reward, ends, goes_on = RewardsAndEnds(
            make_policy_config("e2e_iql", reward_key=key, device="cpu"), dataset.meta
        )(batch)
        assert reward.tolist() == expected
        assert ends.tolist() == [False, True, False]
        assert goes_on.tolist() == [True, False, True]


@pytest.mark.parametrize("reward_key", ["next.reward", "next.success"])
def test_the_world_model_learns_the_reward_that_is_chosen(reward_key: str, dataset: LeRobotDataset) -> None:
    """Its head, set to predict 1 everywhere, errs by what this reward differs from 1."""
    config = make_policy_config("wm_rssm", reward_key=reward_key, window_length=7, device="cpu")
    features = dataset_to_policy_features(dataset.meta.features)
    config.output_features = {"action": features.pop("action")}
    config.input_features = features
    policy = get_policy_class("wm_rssm")(config, dataset.meta.stats, dataset.meta)
    torch.nn.init.zeros_(policy.world_model.reward_head.head.weight)
    torch.nn.init.ones_(policy.world_model.reward_head.head.bias)
    rewards = torch.arange(1.0, 8.0)
    batch = {
        "observation.image": torch.rand(1, 7, 3, 480, 480),
        "action": torch.rand(1, 7, 4),
        "action_is_pad": torch.zeros(1, 7, dtype=torch.bool),
        "next.reward": rewards[None],
        "index": torch.tensor([0]),
    }
    # s_t predicts r_{t-1}: six of the seven count, and the mean is over seven steps.
    expected = 6 / 7 if reward_key == "next.success" else (rewards[:6] - 1).square().sum().item() / 7
    assert policy.forward(batch)[1]["reward_loss"] == pytest.approx(expected, rel=1e-3)


def test_world_model_and_policy(
    flags: str, world_model_path: Path, dataset: LeRobotDataset, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    config = WMRSSMPolicy.from_pretrained(world_model_path).config
    assert config.rssm.predict_reward
    assert config.reward_key == "next.success"
    lerobot_wm_command(
        f"train --policy.type=wm_iql {SUCCESS_REWARD} --policy.world_model_path={world_model_path}",
        f"--steps=2 --batch_size=18 --log_freq=1 {flags} --output_dir={tmp_path / 'run'}",
    )
    policy = get_policy_class("wm_iql").from_pretrained(tmp_path / "run" / CHECKPOINT)
    item = dataset[0]
    batch = {key: item[key][None] for key in ("observation.image", "observation.state")}
    assert policy.select_action({**batch, "task": [item["task"]]}).shape == (1, 4)


def test_both_commands_learn_alike_from_success(
    flags: str, tmp_path: Path, lerobot_wm_command: Command, lerobot_train_command: Command
) -> None:
    run = (
        f"--policy.type=e2e_iql --policy.encoder_image_size=[32,32] --policy.dtype=float32 --policy.dropout=0 "
        f"--steps=2 --batch_size=18 --log_freq=1 {flags}"
    )
    lerobot_train_command(f"{run} {SUCCESS_REWARD} --output_dir={tmp_path}/theirs")
    lerobot_wm_command(f"train {run} {SUCCESS_REWARD} --output_dir={tmp_path}/ours")
    lerobot_wm_command(f"train {run} --output_dir={tmp_path}/dense")
    theirs, ours, dense = (
        load_file(tmp_path / name / CHECKPOINT / "model.safetensors") for name in ("theirs", "ours", "dense")
    )
    for name, tensor in theirs.items():
        torch.testing.assert_close(ours[name], tensor, msg=name)
    value = "agent.value.head.weight"
    assert not torch.allclose(dense[value], ours[value])
    config = json.loads((tmp_path / "ours" / CHECKPOINT / "config.json").read_text())
    assert config["reward_key"] == "next.success"


@pytest.mark.parametrize("policy_type", ["wm_rssm", "e2e_iql"])
def test_a_reward_that_is_not_there(
    policy_type: str, flags: str, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    with pytest.raises(ValueError, match=r"has no .*next\.reward, next\.success"):
        lerobot_wm_command(
            f"train --policy.type={policy_type} --policy.reward_key=next.dense_reward --steps=1 {flags}",
            f"--output_dir={tmp_path / 'run'}",
        )


def test_where_a_task_ends_can_be_named(tmp_path: Path) -> None:
    """LeRobot's recorders set next.done at a time limit, too."""
    keys = {"next.reward": vector(1), "next.done": vector(1, "bool"), "next.success": vector(1, "bool")}
    features = {FRONT: camera(32, 32), "observation.state": vector(3), "action": vector(2), **keys}

    def out_of_time(t: int, length: int) -> dict[str, Any]:
        return {"next.done": np.array([t == length - 1]), "next.success": np.array([False])}

    failed = record(tmp_path / "failed", features, [("Reach", 4)], out_of_time)
    batch = {
        "index": torch.arange(4),
        "next.done": torch.tensor([0.0, 0, 0, 1]),
        "next.reward": torch.zeros(4),
        "observation.state_is_pad": torch.zeros(4, 2, dtype=torch.bool),
    }
    for done_key, expected in (
        (None, [False] * 3 + [True]),
        ("next.success", [False] * 4),
        ("never", [False] * 4),
    ):
        config = make_policy_config("e2e_iql", iql=IQLConfig(done_key=done_key), device="cpu")
        assert RewardsAndEnds(config, failed.meta)(batch)[1].tolist() == expected
    with pytest.raises(ValueError, match=r"has no next\.over"):
        RewardsAndEnds(
            make_policy_config("e2e_iql", iql=IQLConfig(done_key="next.over"), device="cpu"), failed.meta
        )


def test_labels_without_tables_are_no_zeros(dataset: LeRobotDataset, tmp_path: Path) -> None:
    """Of a dataset that is streamed only the metadata is here."""
    shutil.copytree(Path(dataset.root) / "meta", tmp_path / "meta")
    meta = LeRobotDatasetMetadata("test/streamed", root=tmp_path)
    with pytest.raises(FileNotFoundError, match=r"has no tables to read next\.success"):
        RewardsAndEnds(make_policy_config("e2e_iql", device="cpu"), meta)

"""Actions that are targets for the measured state: found in the data, learned relative to it, returned in its units."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.tables import frames_on_disk, relative_to_state
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.world_model.config import RSSMConfig
from tests.recording import camera, record, train_flags, vector

LENGTHS = (30, 20)


def joints(t: int, length: int) -> dict[str, Any]:
    """A state that moves far; two numbers of the action are targets near it, the third is a velocity."""
    state = np.array([np.sin(t / 5), np.cos(t / 7), t / length], dtype=np.float32)
    action = state + np.array([0.1 * np.cos(t / 5), 0.05, 0.0], dtype=np.float32)
    action[2] = np.cos(3 * t)
    return {"observation.state": state, "action": action}


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    features = {"observation.state": vector(3), "action": vector(3)}
    root = tmp_path_factory.mktemp("arm") / "dataset"
    return record(root, features, [("Lift", length) for length in LENGTHS], joints)


def train(command: Callable[..., None], dataset: LeRobotDataset, folder: Path, *flags: str) -> Path:
    command(
        "train --policy.type=wm_bc --policy.use_latent=false --steps=300 --batch_size=32 --policy.dropout=0",
        "--policy.lr=0.003",
        train_flags(dataset),
        f"--output_dir={folder}",
        *flags,
    )
    return folder / "checkpoints" / "last" / "pretrained_model"


def test_targets_are_told_from_velocities(arm: LeRobotDataset, demos: LeRobotDataset) -> None:
    assert relative_to_state(arm.meta) == [0, 1]
    # Meta-World: four velocities beside a state of four numbers.
    assert relative_to_state(demos.meta) == []


def test_episodes_that_are_not_on_this_machine_do_not_count(arm: LeRobotDataset, tmp_path: Path) -> None:
    """Their frames read as zeros, which would lie far from joints that stay near another place."""

    def far(t: int, length: int) -> dict[str, Any]:
        frame = joints(t, length)
        return {
            "observation.state": frame["observation.state"] + 100,
            "action": np.cos(t * np.arange(1, 4)).astype(np.float32) + 100,
        }

    features = {"observation.state": vector(3), "action": vector(3)}
    dataset = record(tmp_path / "dataset", features, [("Lift", 30)] * 2, far)
    assert relative_to_state(dataset.meta) == []
    [table] = (dataset.root / "data").rglob("*.parquet")
    rows = pq.read_table(table)
    pq.write_table(rows.slice(0, 30), table)
    assert relative_to_state(dataset.meta) == []
    action, episode = frames_on_disk(dataset.meta, "action", "episode_index")
    assert action.shape == (30, 3)
    assert episode.max() == 0


def test_the_filter_is_not_told_actions_that_the_last_one_predicts(
    demos: LeRobotDataset, tmp_path: Path
) -> None:
    features = {"observation.image": camera(48, 48), "observation.state": vector(3), "action": vector(3)}

    def slow(t: int, length: int) -> dict[str, Any]:
        state = np.sin(np.array([t / 9, t / 11, t / 13], dtype=np.float32))
        return {"observation.state": state, "action": state + np.float32(0.02)}

    dataset = record(tmp_path / "dataset", features, [("Lift", 60)], slow)
    for meta, share in ((dataset.meta, 0.5), (demos.meta, 0.0)):
        config = WMRSSMConfig(device="cpu", push_to_hub=False)
        config.fill_from_dataset(meta)
        assert config.rssm.hidden_action_share == share
    chosen = WMRSSMConfig(device="cpu", push_to_hub=False, rssm=RSSMConfig(hidden_action_share=0.0))
    chosen.fill_from_dataset(dataset.meta)
    assert chosen.rssm.hidden_action_share == 0.0


def test_actions_that_are_the_state_itself_are_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def copied(t: int, length: int) -> dict[str, Any]:
        state = np.array([np.sin(t / 5), t / length], dtype=np.float32)
        return {"observation.state": state, "action": state}

    features = {"observation.state": vector(2), "action": vector(2)}
    dataset = record(tmp_path / "dataset", features, [("Lift", 20)], copied)
    assert relative_to_state(dataset.meta) == [0, 1]
    assert "stay where it is" in caplog.text


def test_a_policy_returns_units_and_stays_near_an_unseen_state(
    arm: LeRobotDataset, lerobot_wm_command: Callable[..., None], tmp_path: Path
) -> None:
    path = train(lerobot_wm_command, arm, tmp_path / "relative")
    policy = WMBCPolicy.from_pretrained(path)
    assert policy.config.relative_indices == [0, 1]
    frames = [arm[i] for i in range(LENGTHS[0])]
    for frame in frames[::5]:
        action = policy.select_action({"observation.state": frame["observation.state"][None]})[0]
        assert (action - frame["action"])[:2].abs().max() < 0.1
    far = torch.tensor([[7.0, -7.0, 0.5]])  # ten times beyond the recorded states
    action = policy.select_action({"observation.state": far})[0]
    assert (action - far[0])[:2].abs().max() < 0.15  # within the recorded distances
    assert action[2].abs() <= 1.001


def test_false_learns_actions_as_recorded(
    arm: LeRobotDataset, lerobot_wm_command: Callable[..., None], tmp_path: Path
) -> None:
    path = train(lerobot_wm_command, arm, tmp_path / "absolute", "--policy.relative_actions=false")
    assert json.loads((path / "config.json").read_text())["relative_indices"] == []
    changed = PreTrainedConfig.from_pretrained(path)
    changed.relative_actions = None
    with pytest.raises(ValueError, match=r"relative_actions=None.*False"):
        WMBCPolicy.from_pretrained(path, config=changed)
    far = torch.tensor([[7.0, -7.0, 0.5]])
    action = WMBCPolicy.from_pretrained(path).select_action({"observation.state": far})[0]
    assert action.abs().max() <= 1.11  # clipped to the recorded actions


def test_true_needs_as_many_numbers_as_the_state(
    tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    features = {"observation.state": vector(4), "action": vector(3)}
    dataset = record(tmp_path / "dataset", features, [("Lift", 12)])
    with pytest.raises(ValueError, match=r"relative_actions=true.*3 numbers.*4"):
        train(lerobot_wm_command, dataset, tmp_path / "run", "--policy.relative_actions=true")

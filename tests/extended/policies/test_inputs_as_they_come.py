"""Datasets as recorders write them: no state, further vectors, vectors of one number, depth beside colour."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.dream import (
    HELD_ACTION,
    OWN_ACTIONS,
    TRUE_ACTIONS,
    ZERO_ACTIONS,
    DreamConfig,
    dream_of,
)
from lerobot_wm.inspect.episodes import CheckpointConfig
from lerobot_wm.inspect.replay import ReplayConfig, replay
from tests.recording import camera, record, train_flags, vector

FRONT, DEPTH = "observation.images.front", "observation.images.front_depth"
STATE, EFFORT = "observation.state", "observation.effort"
EPISODES = [("Lift", 12), ("Lift", 10)]
REWARDED = {"next.reward": vector(1), "next.done": vector(1, "bool")}
Train = Callable[..., tuple[Any, Path]]


@pytest.fixture(scope="module")
def train(lerobot_wm_command: Callable[..., None], tmp_path_factory: pytest.TempPathFactory) -> Train:
    """Trains a policy for three steps; returns it and its checkpoint."""

    def run(dataset: LeRobotDataset, kind: str, *flags: str) -> tuple[Any, Path]:
        folder = tmp_path_factory.mktemp("run") / "run"
        lerobot_wm_command(
            f"train --policy.type={kind} --steps=3 --batch_size=4 --output_dir={folder}",
            train_flags(dataset),
            *flags,
        )
        path = folder / "checkpoints" / "last" / "pretrained_model"
        return get_policy_class(kind).from_pretrained(path), path

    return run


def world_model_flag(train: Train, dataset: LeRobotDataset, *flags: str) -> str:
    _, path = train(dataset, "wm_rssm", "--policy.window_length=4", *flags)
    return f"--policy.world_model_path={path}"


def labels_of(features: dict[str, Any]) -> Callable[[int, int], dict[str, Any]]:
    """An action of one number, a target for the state of one number; success in the last frame."""

    def labels(t: int, length: int) -> dict[str, Any]:
        state, is_last = np.array([np.sin(t / 3)], dtype=np.float32), t == length - 1
        known = {
            STATE: state,
            "action": state + np.float32(0.1 * np.cos(t)),
            DEPTH: np.full((32, 32, 1), 100 * t, dtype=np.uint16),
            "next.reward": np.array([is_last], dtype=np.float32),
            "next.done": np.array([is_last]),
        }
        return {key: value for key, value in known.items() if key in features}

    return labels


@pytest.fixture(scope="module")
def stateless(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    """A camera, an action of one number, rewards."""
    features = {FRONT: camera(32, 32), "action": vector(1), **REWARDED}
    return record(tmp_path_factory.mktemp("stateless") / "dataset", features, EPISODES, labels_of(features))


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    """Colour and depth, a state and an action of one number, efforts, rewards."""
    depth = {**camera(32, 32), "shape": (32, 32, 1), "info": {"is_depth_map": True}}
    vectors = {STATE: vector(1), EFFORT: vector(3), "action": vector(1)}
    features = {FRONT: camera(32, 32), DEPTH: depth, **vectors, **REWARDED}
    return record(tmp_path_factory.mktemp("rich") / "dataset", features, EPISODES, labels_of(features))


def test_policies_act_without_proprioception_on_one_number(stateless: LeRobotDataset, train: Train) -> None:
    world_model = world_model_flag(train, stateless)
    source = SourceConfig("test/recorded", str(stateless.root))
    for kind, flags in (("wm_bc", world_model), ("wm_iql", world_model), ("e2e_bc", ""), ("e2e_iql", "")):
        policy, path = train(stateless, kind, flags)
        assert policy.config.state_dim == 0
        assert list(policy.config.input_features) == [FRONT]
        policy.config.action_noise = 0.1
        action = policy.select_action({FRONT: torch.rand(2, 3, 32, 32), "task": ["Lift"] * 2})
        assert action.shape == (2, 1)
        replayed = replay(ReplayConfig(CheckpointConfig(str(path)), source, episodes=[1]))
        assert all(actions[1].shape == (10, 1) for actions in replayed.actions.values())
        if kind.startswith("wm"):
            cfg = DreamConfig(CheckpointConfig(str(path)), source, 1, output_dir=path.parent / "dream")
            assert list(dream_of(cfg).by_actions) == [TRUE_ACTIONS, ZERO_ACTIONS, OWN_ACTIONS]


def test_a_policy_that_would_see_nothing_is_refused(stateless: LeRobotDataset, train: Train) -> None:
    with pytest.raises(ValueError, match=r"use_latent=false.*state_keys"):
        train(stateless, "wm_bc", "--policy.use_latent=false")


def test_vectors_are_joined_in_the_order_of_state_keys(
    rich: LeRobotDataset, train: Train, lerobot_train_command: Callable[[str], None], tmp_path: Path
) -> None:
    keys = f"--policy.state_keys={EFFORT},{STATE}"
    world_model = world_model_flag(train, rich, "--policy.rssm.use_proprio=true", keys)
    for kind, flags in (("wm_bc", world_model), ("e2e_iql", "")):
        policy, _ = train(rich, kind, flags, keys)
        assert policy.config.state_vectors == [EFFORT, STATE]
        assert set(policy.config.input_features) == {FRONT, EFFORT, STATE}
        means = [rich.meta.stats[key]["mean"] for key in (EFFORT, STATE)]
        assert policy.state_scaling.offset.numpy() == pytest.approx(np.concatenate(means), abs=1e-6)
        # The action's one number is a target for the state, which is the fourth number of the proprioception.
        assert policy.config.relative_indices == [0]
        assert policy.config.relative_state_indices == [3]
        frame = {FRONT: torch.rand(1, 3, 32, 32), EFFORT: torch.zeros(1, 3), "task": ["Lift"]}
        action = policy.select_action(frame | {STATE: torch.tensor([[9.0]])})
        assert (action - 9).abs().max() <= 0.11
    lerobot_train_command(
        f"--policy.type=e2e_bc {keys} --steps=2 --batch_size=4 --output_dir={tmp_path / 'run'} {train_flags(rich)}"
    )
    path = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    assert json.loads((path / "config.json").read_text())["state_keys"] == f"{EFFORT},{STATE}"
    config = PreTrainedConfig.from_pretrained(path)
    config.state_keys = STATE
    with pytest.raises(ValueError, match=rf"state_keys.*{EFFORT}, {STATE}"):
        get_policy_class("e2e_bc").from_pretrained(path, config=config)
    with pytest.raises(ValueError, match=r"observation\.torque.*observation\.effort"):
        train(rich, "e2e_bc", "--policy.state_keys=observation.torque")


def test_targets_are_held_in_dreams_in_place_of_zero(rich: LeRobotDataset, train: Train) -> None:
    _, path = train(rich, "wm_rssm", "--policy.window_length=4")
    source = SourceConfig("test/recorded", str(rich.root))
    cfg = DreamConfig(CheckpointConfig(str(path)), source, 1, output_dir=path.parent / "dream")
    dreams = dream_of(cfg)
    assert list(dreams.by_actions) == [TRUE_ACTIONS, HELD_ACTION]
    assert len(dreams.by_actions[HELD_ACTION].images) == 10


def test_colour_and_the_state_are_read_by_default_and_the_rest_is_named(
    rich: LeRobotDataset, train: Train, capsys: pytest.CaptureFixture[str]
) -> None:
    policy, _ = train(rich, "e2e_bc")
    log = capsys.readouterr().err
    assert set(policy.config.input_features) == {FRONT, STATE}
    for told in (f"--policy.state_keys={STATE},{EFFORT}", "--policy.image_key", DEPTH):
        assert told in log

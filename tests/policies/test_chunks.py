"""Chunks of actions: how they are learned, and executed while the filter reads every frame."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import make_policy
from torch import Tensor

from lerobot_wm.policies.e2e_bc.modeling_e2e_bc import E2EBCPolicy
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from tests.recording import record, train_flags, vector

LENGTH = 30
CHUNK = 4


def circle(t: int, length: int) -> dict[str, Any]:
    """A state on a circle and a target for it, one frame ahead."""
    place = [np.array([np.sin(at / 4), np.cos(at / 4)], dtype=np.float32) for at in (t, t + 1)]
    return {"observation.state": place[0], "action": place[1]}


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    features = {"observation.state": vector(2), "action": vector(2)}
    return record(tmp_path_factory.mktemp("arm") / "dataset", features, [("Turn", LENGTH)] * 2, circle)


@pytest.mark.parametrize("head", ["regression", "flow"])
def test_a_chunk_holds_the_next_actions_and_is_executed_in_order(
    head: str, arm: LeRobotDataset, lerobot_wm_command: Callable[..., None], tmp_path: Path
) -> None:
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.use_latent=false --policy.chunk_size={CHUNK} --policy.n_action_steps=3",
        f"--policy.head={head} --steps=600 --batch_size=32 --policy.dropout=0 --policy.lr=0.003",
        train_flags(arm),
        f"--output_dir={tmp_path / 'run'}",
    )
    policy = WMBCPolicy.from_pretrained(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model")
    frames = [arm[t] for t in range(LENGTH)]
    batches = [{"observation.state": frame["observation.state"][None]} for frame in frames]
    for t in range(LENGTH - CHUNK):
        policy.reset()
        chunk = policy.predict_action_chunk(batches[t])
        expected = torch.stack([frame["action"] for frame in frames[t : t + CHUNK]])
        assert chunk.shape == (1, CHUNK, 2)
        assert (chunk[0] - expected).abs().mean() < (0.1 if head == "regression" else 0.2)
    policy.reset()
    first, *_ = chunks = [policy.predict_action_chunk(batches[t]) for t in (0, 3)]
    policy.reset()
    executed = torch.stack([policy.select_action(batches[t]) for t in range(6)], dim=1)
    assert torch.equal(executed, torch.cat([chunk[:, :3] for chunk in chunks], dim=1))
    policy.reset()
    policy.select_action(batches[0])
    policy.drop_queued_actions()
    assert not torch.equal(policy.select_action(batches[10]), first[:, 1])


def test_padding_past_the_end_of_an_episode_is_left_out_of_the_loss(arm: LeRobotDataset) -> None:
    config = WMBCConfig(device="cpu", push_to_hub=False, use_latent=False, chunk_size=CHUNK, dropout=0.0)
    torch.manual_seed(0)
    policy = make(config, arm)
    batch: dict[str, Any] = {
        "observation.state": torch.randn(3, 2),
        "action": torch.randn(3, CHUNK, 2),
        "action_is_pad": torch.tensor([[False] * 4, [False, False, True, True], [False, True, True, True]]),
        "task": ["Turn"] * 3,
    }
    loss, _ = policy.forward(batch)
    batch["action"][batch["action_is_pad"]] = 100.0
    assert policy.forward(batch)[0].item() == pytest.approx(loss.item())
    batch["action"][0, 3] = 100.0
    assert policy.forward(batch)[0].item() > loss.item()


def make(config: WMBCConfig, dataset: LeRobotDataset) -> WMBCPolicy:
    policy = make_policy(config, ds_meta=dataset.meta)
    assert isinstance(policy, WMBCPolicy)
    return policy


def test_chunks_of_targets_relative_to_the_state_keep_their_range(arm: LeRobotDataset) -> None:
    config = WMBCConfig(device="cpu", push_to_hub=False, use_latent=False, chunk_size=CHUNK)
    policy = make(config, arm)
    assert policy.config.relative_indices == [0, 1]
    frames = [arm[t] for t in range(LENGTH)]
    action, state = (torch.stack([f[key] for f in frames]) for key in ("action", "observation.state"))
    chunks = action.unfold(0, CHUNK, 1).movedim(-1, 1)  # (N, K, A)
    first = state[: len(chunks)]
    scaled = policy.scaled(chunks, first)
    # Each step of a chunk spans the range: later ones reach further, and would outweigh the first.
    torch.testing.assert_close(scaled.abs().amax((0, 2)), torch.ones(CHUNK), atol=1e-3, rtol=0)
    torch.testing.assert_close(policy.unscaled(scaled, first), chunks)


def test_the_filter_reads_every_frame_between_predictions(
    demos: LeRobotDataset,
    world_model_path: Path,
    latents_root: Path,
    lerobot_wm_command: Callable[..., None],
    tmp_path: Path,
) -> None:
    """Executing three actions of each chunk, it ends in the state to which the same actions lead a filter alone."""
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --policy.chunk_size={CHUNK}",
        "--policy.n_action_steps=3 --steps=2 --batch_size=8",
        train_flags(LeRobotDataset("test/latents", root=latents_root)),
        f"--output_dir={tmp_path / 'run'}",
    )
    policy = WMBCPolicy.from_pretrained(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model")
    keys = ("observation.image", "observation.state")
    frames = [demos[t] for t in range(5)]
    batches = [{key: f[key][None] for key in keys} | {"task": [f["task"]]} for f in frames]
    actions = torch.cat([policy.select_action(batch) for batch in batches])  # (5, A)
    images = torch.stack([f["observation.image"] for f in frames])[None]
    size = policy.config.image_size
    resized = torch.nn.functional.interpolate(images[0], size)[None] if images.shape[-2:] != size else images
    with torch.no_grad():
        states = policy.world_model.filter(resized, actions[None])
    torch.testing.assert_close(policy._filter_state.latent, states.last().latent, atol=2e-5, rtol=2e-5)


def test_noise_stays_within_the_range_of_each_step(arm: LeRobotDataset) -> None:
    exact, noisy = (
        make(
            WMBCConfig(device="cpu", push_to_hub=False, use_latent=False, chunk_size=CHUNK, action_noise=std),
            arm,
        )
        for std in (0.0, 0.5)
    )
    noisy.load_state_dict(exact.state_dict())
    batch = {"observation.state": torch.zeros(1, 2)}
    mean, drawn = (policy.predict_action_chunk(batch) for policy in (exact, noisy))
    assert not torch.equal(mean, drawn)
    assert noisy.scaled(drawn, torch.zeros(1, 2)).abs().max() < 1.001
    noisy.reset()
    assert torch.equal(drawn, noisy.predict_action_chunk(batch))  # the rollout repeats


def test_settings_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"n_action_steps=5.*4"):
        WMBCConfig(device="cpu", chunk_size=4, n_action_steps=5)
    with pytest.raises(ValueError, match=r"head='mixture'.*regression.*flow"):
        WMBCConfig(device="cpu", head="mixture")


def test_end_to_end_policies_predict_chunks_too(
    demos: LeRobotDataset, lerobot_wm_command: Callable[..., None], tmp_path: Path
) -> None:
    lerobot_wm_command(
        f"train --policy.type=e2e_bc --policy.chunk_size={CHUNK} --policy.n_action_steps=3 --policy.head=flow",
        "--steps=2 --batch_size=4",
        train_flags(demos),
        f"--output_dir={tmp_path / 'run'}",
    )
    policy = E2EBCPolicy.from_pretrained(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model")
    frame = demos[0]
    batch: dict[str, Any] = {key: frame[key][None] for key in ("observation.image", "observation.state")}
    batch["task"] = [frame["task"]]
    assert policy.predict_action_chunk(batch).shape == (1, CHUNK, 4)

    encoded: list[Tensor] = []
    policy.encoder.register_forward_hook(lambda _module, _inputs, features: encoded.append(features))
    policy.reset()
    for _ in range(6):
        policy.select_action(batch)
    assert len(encoded) == 2, "images are encoded only where actions are predicted"

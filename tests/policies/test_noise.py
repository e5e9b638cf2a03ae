"""Noise on actions at test time, and on proprioception in training."""

from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_policy
from torch import Tensor

from lerobot_wm.policies.common.acting_policy import ActingPolicy
from lerobot_wm.policies.common.actions import RolloutNoise

STD = 0.3


def batch_of(rows: list[float]) -> dict[str, Any]:
    return {"observation.state": torch.tensor(rows)[:, None], "task": ["a"] * len(rows)}


def noise_of(rows: list[float], n_steps: int) -> Tensor:
    """Noise of rollouts that start with these states, (T, B, A)."""
    noise = RolloutNoise()
    first, later = batch_of(rows), batch_of([9.0] * len(rows))
    zero = torch.zeros(len(rows), 4)
    return torch.stack([noise(zero, first if step == 0 else later) for step in range(n_steps)])


def test_each_rollout_has_its_own_noise_whatever_else_is_in_the_batch() -> None:
    torch.manual_seed(0)
    together = noise_of([0.0, 1.0, 2.0], 5)
    torch.manual_seed(1)
    for i, row in enumerate([0.0, 1.0, 2.0]):
        assert torch.equal(noise_of([row], 5)[:, 0], together[:, i])
    assert not torch.equal(together[:, 0], together[:, 1])
    assert not torch.equal(together[0], together[1])


def test_noise_is_gaussian() -> None:
    noise = noise_of([0.0, 1.0], 4000)
    assert noise.mean().abs() < 0.03
    assert noise.std(dim=(0, 1)).tolist() == pytest.approx([1.0] * 4, rel=0.03)
    correlation = torch.corrcoef(torch.cat([noise[:, 0], noise[:, 1]], dim=1).T) - torch.eye(8)
    assert correlation.abs().max() < 0.08


def load(path: Path, policy_type: str, std: float) -> ActingPolicy:
    config = PreTrainedConfig.from_pretrained(path)
    config.action_noise = std
    return get_policy_class(policy_type).from_pretrained(path, config=config)


@pytest.mark.parametrize("policy_type", ["wm_bc", "wm_iql"])
def test_policies_act_with_noise_within_the_dataset_s_range(
    policy_paths: dict[str, Path], demos: LeRobotDataset, policy_type: str
) -> None:
    exact, noisy = (load(policy_paths[policy_type], policy_type, std) for std in (0.0, STD))
    low, high = (torch.as_tensor(demos.meta.stats["action"][key]) for key in ("min", "max"))
    differences = []
    for index in range(10):
        item = demos[index]
        batch = {key: item[key][None] for key in ("observation.image", "observation.state")}
        batch["task"] = [item["task"]]
        action = noisy.select_action(batch)
        assert torch.equal(noisy._prev_action, action)  # the filter reads what was executed
        assert (action >= low - 1e-6).all()
        assert (action <= high + 1e-6).all()
        differences.append(action - exact.select_action(batch))
    assert 0.1 < torch.stack(differences).std() < 0.6
    noisy.reset()
    first = {key: demos[0][key][None] for key in ("observation.image", "observation.state")}
    repeated = noisy.select_action({**first, "task": [demos[0]["task"]]})
    exact.reset()
    torch.testing.assert_close(
        repeated - exact.select_action({**first, "task": [demos[0]["task"]]}), differences[0]
    )


@pytest.mark.parametrize("policy_type", ["wm_bc", "e2e_bc"])
def test_proprioception_has_noise_in_training_alone(demos: LeRobotDataset, policy_type: str) -> None:
    blind = {"use_latent": False} if policy_type == "wm_bc" else {}
    config = get_policy_class(policy_type).config_class(device="cpu", state_noise=STD, **blind)
    policy = make_policy(config, ds_meta=demos.meta)
    batch = {key: demos[0][key].expand(500, *demos[0][key].shape) for key in config.input_features}
    batch["task"] = [demos[0]["task"]] * 500

    def observation() -> Tensor:  # as in training, with tasks before proprioception
        state, tasks = policy.state_at(batch), policy.one_hot_tasks(batch, 500)
        inputs = (policy.images(batch), state, tasks) if policy_type == "e2e_bc" else (state, tasks, None)
        return policy.observation(*inputs)

    policy.eval()
    exact = observation()
    policy.train()
    noise = observation() - exact  # (500, O)
    assert noise[:, -4:].std(0).tolist() == pytest.approx([STD] * 4, rel=0.15)
    assert not noise[:, :-4].any()


@pytest.mark.parametrize("setting", ["action_noise", "state_noise"])
def test_negative_noise_is_refused(setting: str) -> None:
    with pytest.raises(ValueError, match=rf"{setting}=-0.1.*0 or more"):
        get_policy_class("wm_bc").config_class(**{setting: -0.1})

"""Updates of our IQL and BC heads on a batch in memory."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.sides.shared import OBSERVATION_DIM
from benchmarks.timing import Prepared, timed_updates
from lerobot_wm.constants import ACTION_DIM
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_iql.configuration_wm_iql import WMIQLConfig
from lerobot_wm.rl.bc import bc_loss
from lerobot_wm.rl.iql import IQLAgent


def iql(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time updates of the IQL agent of `wm_iql`, target networks included."""
    torch.manual_seed(0)
    config = WMIQLConfig(device="cpu")
    agent = IQLAgent(
        OBSERVATION_DIM,
        ACTION_DIM,
        betas=[config.iql.beta],
        hidden_dims=config.hidden_dims,
        dropout=config.dropout,
        expectile=config.iql.expectile,
        discount=config.iql.discount,
        target_rate=config.iql.target_rate,
    )
    optimizer = config.get_optimizer_preset().build(agent.param_groups())
    scheduler = config.get_scheduler_preset().build(optimizer, 1_000_000)
    observation, next_observation = torch.randn(2, batch, OBSERVATION_DIM)  # (B, O) each
    action = torch.rand(batch, ACTION_DIM) * 2 - 1  # (B, A)
    reward = (torch.rand(batch) < 0.1).float()  # (B,)
    has_next = torch.ones(batch, dtype=torch.bool)

    def loss() -> Tensor:
        return agent.loss(observation, next_observation, action, reward, reward.bool(), has_next)[0]

    def update() -> None:
        _descend(loss, optimizer, config.dtype)
        scheduler.step()
        agent.update_target()

    return timed_updates(update, seconds, {"dtype": str(config.dtype)})


def bc(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time updates of the regression of `wm_bc`."""
    torch.manual_seed(0)
    config = WMBCConfig(device="cpu")
    actor = MLP(OBSERVATION_DIM, config.hidden_dims, ACTION_DIM, torch.nn.ReLU, config.dropout)
    optimizer = config.get_optimizer_preset().build(actor.parameters())
    observation = torch.randn(batch, OBSERVATION_DIM)  # (B, O)
    action = torch.rand(batch, ACTION_DIM) * 2 - 1  # (B, A)

    def update() -> None:
        _descend(lambda: bc_loss(actor(observation), action), optimizer, config.dtype)

    return timed_updates(update, seconds, {"dtype": str(config.dtype)})


def _descend(loss: Callable[[], Tensor], optimizer: torch.optim.Optimizer, dtype: str | None) -> None:
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=dtype == "bfloat16"):
        value = loss()
    value.backward()
    optimizer.step()
    optimizer.zero_grad()

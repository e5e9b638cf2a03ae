"""Updates of TorchRL's IQLLoss and BCLoss with our network sizes and settings, and one Adam for all."""

from collections.abc import Callable
from pathlib import Path

import torch
import torchrl
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import BCLoss, IQLLoss, SoftUpdate

from benchmarks.sides.shared import (
    ACTION_DIM,
    BETA,
    DISCOUNT,
    DROPOUT,
    EXPECTILE,
    HIDDEN_DIMS,
    LEARNING_RATE,
    OBSERVATION_DIM,
    TARGET_RATE,
)
from benchmarks.timing import Prepared, timed_updates

FACTS = {"dtype": "float32", "torchrl": torchrl.__version__}


def iql(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time updates of IQL, target networks included."""
    torch.manual_seed(0)
    mean = nn.Sequential(_mlp(OBSERVATION_DIM, ACTION_DIM, DROPOUT), nn.Tanh())
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(mean, AddStateIndependentNormalScale(ACTION_DIM)),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
    )
    critic = ValueOperator(_mlp(OBSERVATION_DIM + ACTION_DIM, 1), in_keys=["observation", "action"])
    value = ValueOperator(_mlp(OBSERVATION_DIM, 1), in_keys=["observation"])
    losses = IQLLoss(
        actor, critic, value, loss_function="l2", temperature=BETA, expectile=EXPECTILE, num_qvalue_nets=2
    )
    losses.make_value_estimator(gamma=DISCOUNT)
    target = SoftUpdate(losses, tau=TARGET_RATE)
    optimizer = torch.optim.Adam(losses.parameters(), lr=LEARNING_RATE)
    reward = (torch.rand(batch, 1) < 0.1).float()
    data = TensorDict(
        {
            "observation": torch.randn(batch, OBSERVATION_DIM),
            "action": torch.rand(batch, ACTION_DIM) * 2 - 1,
            "next": {
                "observation": torch.randn(batch, OBSERVATION_DIM),
                "reward": reward,
                "done": reward.bool(),
                "terminated": reward.bool(),
            },
        },
        [batch],
    )

    def loss() -> Tensor:
        parts = losses(data)
        return parts["loss_actor"] + parts["loss_qvalue"] + parts["loss_value"]

    def update() -> None:
        _descend(loss, optimizer)
        target.step()

    return timed_updates(update, seconds, FACTS)


def bc(folder: Path, batch: int, seconds: float) -> Prepared:
    """Time updates of BC."""
    torch.manual_seed(0)
    actor = TensorDictModule(
        _mlp(OBSERVATION_DIM, ACTION_DIM, DROPOUT), in_keys=["observation"], out_keys=["action"]
    )
    losses = BCLoss(actor, loss_function="l2")
    optimizer = torch.optim.Adam(losses.parameters(), lr=LEARNING_RATE)
    data = TensorDict(
        {
            "observation": torch.randn(batch, OBSERVATION_DIM),
            "action": torch.rand(batch, ACTION_DIM) * 2 - 1,
        },
        [batch],
    )
    return timed_updates(lambda: _descend(lambda: losses(data)["loss_bc"], optimizer), seconds, FACTS)


def _mlp(inputs: int, outputs: int, dropout: float = 0.0) -> MLP:
    return MLP(inputs, outputs, num_cells=HIDDEN_DIMS, activation_class=nn.ReLU, dropout=dropout or None)


def _descend(loss: Callable[[], Tensor], optimizer: torch.optim.Optimizer) -> None:
    loss().backward()
    optimizer.step()
    optimizer.zero_grad()

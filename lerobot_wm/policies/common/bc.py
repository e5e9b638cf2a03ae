"""What the policies share that learn by behaviour cloning: chunks of actions, and the head that predicts them."""

from dataclasses import dataclass
from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import ACTION
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.common.acting_config import ActingConfig
from lerobot_wm.policies.common.acting_policy import ActingPolicy
from lerobot_wm.policies.common.config import compiled
from lerobot_wm.rl.bc import FlowHead, bc_loss, mean_without_padding

HEADS = ("regression", "flow")


@dataclass
class BCPolicyConfig(ActingConfig):
    """A policy that is trained by behaviour cloning.

    Args:
        chunk_size: K, how many actions a_t ... a_{t+K-1} are predicted from frame t.
        n_action_steps: How many of them are executed before the next prediction. The filter reads every frame.
        head: "regression" learns the mean action (paper section 3.1.2); "flow" samples actions by flow matching, for
            demonstrations that solve a task in several ways.
    """

    chunk_size: int = 1
    n_action_steps: int = 1
    head: str = "regression"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.head not in HEADS:
            raise ValueError(f"--policy.head={self.head!r} is not one of {', '.join(HEADS)}.")
        if not 1 <= self.n_action_steps <= self.chunk_size:
            raise ValueError(
                f"--policy.n_action_steps={self.n_action_steps}: expected 1 to --policy.chunk_size={self.chunk_size}."
            )

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Frames of a chunk, relative to its first; None for single actions."""
        return None if self.chunk_size == 1 else list(range(self.chunk_size))


class BCPolicy(ActingPolicy):
    """Base of `wm_bc` and `e2e_bc`: the head on [features of the images, one-hot task, proprioception]."""

    config: BCPolicyConfig

    def build(self) -> None:
        """Make what the observation needs, and the head."""
        super().build()
        config = self.config
        size = config.chunk_size * config.action_dim
        self.actor: MLP | FlowHead = (
            FlowHead(self.observation_dim, config.hidden_dims, size, config.dropout)
            if config.head == "flow"
            else MLP(self.observation_dim, config.hidden_dims, size, nn.ReLU, config.dropout)
        )

    def prepare_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Compile the loss, with `compile_model`."""
        if self.config.compile_model:
            self.loss = compiled(self.loss)  # type: ignore[method-assign]

    @property
    def chunk_size(self) -> int:
        """K."""
        return self.config.chunk_size

    @property
    def n_action_steps(self) -> int:
        """How many actions of a chunk are executed."""
        return self.config.n_action_steps

    def observation_networks(self) -> list[MLP]:
        """The network of the head that reads the observation."""
        return [self.actor.observe if isinstance(self.actor, FlowHead) else self.actor]

    def actor_chunk(self, observation: Tensor, batch: dict[str, Any] | None = None) -> Tensor:
        """The actions (B, K, A) that the head predicts or samples, scaled to [-1, 1], for observations (B, O)."""
        shape = (self.chunk_size, self.config.action_dim)
        if not isinstance(self.actor, FlowHead):
            return self.actor(observation).unflatten(-1, shape)
        start = observation.new_zeros(len(observation), shape[0] * shape[1])
        if batch is not None:
            start = self._noise(start, batch)
        return self.actor(observation, start).unflatten(-1, shape)

    def head_loss(self, observation: Tensor, batch: dict[str, Any]) -> Tensor:
        """The head's scalar loss on observations (B, O), given a training batch.

        Args:
            observation: What the head reads.
            batch: `action` (B, A); with chunks (B, K, A), and `action_is_pad` (B, K), True past the end of an episode.
        """
        action = self.scaled(batch[ACTION], self.state_at(batch))
        return self.loss(observation, action, batch.get(f"{ACTION}_is_pad"))

    def loss(self, observation: Tensor, action: Tensor, is_pad: Tensor | None) -> Tensor:
        """The head's scalar loss, given scaled actions (B, A) or (B, K, A)."""
        if isinstance(self.actor, FlowHead):
            error = self.actor.errors(observation, action.flatten(1)).view_as(action)
            return mean_without_padding(error, is_pad)
        return bc_loss(self.actor(observation).view_as(action), action, is_pad)

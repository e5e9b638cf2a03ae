"""Implicit Q-learning for policies: settings, agent, and the rewards and ends of tasks in LeRobot's batches."""

from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_STR
from torch import Tensor, nn

from lerobot_wm.constants import DONE, REWARD, SUCCESS
from lerobot_wm.data.tables import frame_values
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.common.acting_config import ActingConfig
from lerobot_wm.policies.common.acting_policy import ActingPolicy
from lerobot_wm.policies.common.config import compiled
from lerobot_wm.policies.common.optim import ActorCosineConfig
from lerobot_wm.rl.iql import IQLAgent

NEVER = "never"  # for `done_key`
# The next.* columns that LeRobot's processors let through; others are read from the dataset by frame index.
IN_BATCHES = (REWARD, DONE)


@dataclass
class IQLConfig:
    """The paper's IQL settings (section 3.1.2); the rest from the IQL reference implementation.

    Args:
        beta: Inverse temperature, which multiplies the advantage. With a 0/1 reward that ends the episode, Q and V lie
            in [0, 1], so that at 0.5 every weight exp(β·A) lies in [0.61, 1.65]: IQL is then close to BC. At evaluation
            it selects one of the actors in `trained_betas`.
        sweep_betas: More inverse temperatures, each with an actor of its own, trained on the same critics; 0 is
            behaviour cloning by likelihood. In e2e_iql only the main actor shapes the image encoder.
        expectile: Expectile τ of the value regression.
        discount: γ.
        target_rate: Polyak rate of the target critics.
        done_key: The dataset's column that is true where an action ended the task, not where time ran out. None takes
            next.done, or next.success in a dataset without it. LeRobot's recorders set next.done at a time limit too:
            use next.success for their data, or next.reward where there is none and the reward is 0/1. "never": no
            action ends the task. This matters for rewards above zero along the way: an action that ends such a task
            loses all later reward, and the policy learns to avoid success.
        trained_betas: β of every actor, the main one first; filled when the policy is created.
    """

    beta: float = 0.5
    sweep_betas: list[float] = field(default_factory=list)
    expectile: float = 0.7
    discount: float = 0.99
    target_rate: float = 0.005
    done_key: str | None = None
    trained_betas: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not 0 < self.expectile < 1:
            raise ValueError(f"--policy.iql.expectile={self.expectile:g}: expected above 0 and below 1.")
        if not 0 <= self.discount <= 1:
            raise ValueError(f"--policy.iql.discount={self.discount:g}: expected 0 to 1.")
        if not 0 < self.target_rate <= 1:
            raise ValueError(
                f"--policy.iql.target_rate={self.target_rate:g}: expected above 0 and at most 1."
            )
        for beta in (self.beta, *self.sweep_betas):
            if beta < 0:
                raise ValueError(f"--policy.iql.beta or sweep_betas: {beta:g}; expected 0 or more.")

    def schedule(self, lr_decay_share: float) -> ActorCosineConfig:
        """Cosine decay on the actors only.

        Raises:
            ValueError: Another schedule was asked for.
        """
        if lr_decay_share:
            raise ValueError(
                f"--policy.lr_decay_share={lr_decay_share:g}: IQL has a schedule of its own, a cosine on the actors. "
                "Leave the flag out."
            )
        return ActorCosineConfig()

    def choose_actors(self) -> None:
        """Note β of every actor in `trained_betas`, unless a checkpoint has.

        Raises:
            ValueError: No actor of the checkpoint was trained with `beta` or one of `sweep_betas`.
        """
        wanted = list(dict.fromkeys([self.beta, *self.sweep_betas]))
        self.trained_betas = self.trained_betas or wanted
        unknown = [beta for beta in wanted if beta not in self.trained_betas]
        if unknown:
            raise ValueError(
                f"No actor of this checkpoint was trained with beta {_numbers(unknown)}; it has actors for betas "
                f"{_numbers(self.trained_betas)}. Set --policy.iql.beta to one of these, or train a new policy with "
                f"--policy.iql.sweep_betas='[{_numbers(unknown)}]'."
            )


@dataclass
class IQLPolicyConfig(ActingConfig):
    """A policy that is trained by IQL, with the settings of the paper (section 3.1.2).

    Args:
        iql: Settings of IQL.
        reward_key: The dataset's column that is the reward: next.success for a sparse reward of 1 at success, where
            next.reward is a dense one.
    """

    iql: IQLConfig = field(default_factory=IQLConfig)
    reward_key: str = REWARD

    @property
    def observation_delta_indices(self) -> list[int]:
        """Observations at t and t+1."""
        return [0, 1]

    def get_scheduler_preset(self) -> ActorCosineConfig:
        """Cosine decay on the actors only."""
        return self.iql.schedule(self.lr_decay_share)

    def check_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Check that the dataset has the reward, and says where a task ends."""
        end_column(self, dataset_meta)

    def fill_from_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """A new policy has actors of its own."""
        super().fill_from_dataset(dataset_meta)
        self.iql.trained_betas = []

    def validate_features(self) -> None:
        """Also note β of every actor."""
        super().validate_features()
        self.iql.choose_actors()


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


class IQLPolicy(ActingPolicy):
    """Base of `wm_iql` and `e2e_iql`: an agent on [features of the images, one-hot task, proprioception]."""

    config: IQLPolicyConfig

    def build(self) -> None:
        """Make what the observation needs, and the agent."""
        super().build()
        config, iql = self.config, self.config.iql
        self.agent = IQLAgent(
            self.observation_dim,
            config.action_dim,
            betas=iql.trained_betas,
            hidden_dims=config.hidden_dims,
            dropout=config.dropout,
            expectile=iql.expectile,
            discount=iql.discount,
            target_rate=iql.target_rate,
        )
        self.rewards_and_ends = RewardsAndEnds(config)

    def prepare_training(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Read rewards and ends from the dataset's columns; compile the agent's loss, with `compile_model`."""
        self.rewards_and_ends = RewardsAndEnds(self.config, dataset_meta)
        if self.config.compile_model:
            self.agent.loss = compiled(self.agent.loss)  # type: ignore[method-assign]

    def observation_networks(self) -> list[MLP]:
        """The agent's networks."""
        return self.agent.networks()

    def actor_chunk(self, observation: Tensor, batch: dict[str, Any] | None = None) -> Tensor:
        """Mean of the policy's Gaussian (B, 1, A) for observations (B, O)."""
        return self.agent.mean_action(observation, self.config.iql.beta)[:, None]

    def update(self) -> None:
        """Move the target critics; LeRobot calls this after every optimizer step."""
        self.agent.update_target()


def reward_columns(dataset_meta: LeRobotDatasetMetadata) -> list[str]:
    """The columns next.* with one number per frame; each can be a reward."""
    return [
        name
        for name, feature in dataset_meta.features.items()
        if name.startswith("next.") and name != DONE and tuple(feature["shape"]) == (1,)
    ]


class FrameColumn(nn.Module):
    """A column with one number per frame, read from training batches.

    Args:
        key: The column.
        dataset_meta: The training dataset; needed for columns that LeRobot's batches leave out.
    """

    values: Tensor

    def __init__(self, key: str, dataset_meta: LeRobotDatasetMetadata | None = None) -> None:
        super().__init__()
        self.key = key
        if dataset_meta is not None and key not in IN_BATCHES:
            # (N,) by absolute frame index. It belongs to the dataset, not to checkpoints.
            self.register_buffer("values", frame_values(dataset_meta, key), persistent=False)

    def forward(self, batch: dict[str, Any], n_steps: int = 1) -> Tensor:
        """The column at each frame of the batch and at the `n_steps` - 1 frames after it: (B, n_steps).

        Beyond the end of an episode these are the next episode's numbers, which the caller masks.
        """
        if self.key in IN_BATCHES:
            return batch[self.key]
        steps = torch.arange(n_steps, device=self.values.device)
        index = batch["index"].reshape(-1, 1) + steps  # (B, n_steps)
        return self.values[index.clamp(max=len(self.values) - 1)]


class RewardsAndEnds(nn.Module):
    """Reads from training batches the reward of each action, whether it ended the task, and whether data follow.

    Args:
        config: The configuration of a policy with `iql`.
        dataset_meta: The training dataset; None for a policy that only acts.

    Raises:
        ValueError: The dataset has no reward, or no column that says where a task ends.
    """

    def __init__(self, config: IQLPolicyConfig, dataset_meta: LeRobotDatasetMetadata | None = None) -> None:
        super().__init__()
        end = DONE if dataset_meta is None else end_column(config, dataset_meta)
        self.reward = FrameColumn(config.reward_key, dataset_meta)
        self.end = None if end is None else FrameColumn(end, dataset_meta)

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor]:
        """The arguments of `IQLAgent.loss` after the action.

        Args:
            batch: `next.reward` (B,) and `next.done` (B,), or `index` (B,) where other columns are read; an
                observation's `_is_pad` (B, 2) at t and t+1.

        Returns:
            Rewards (B,), ends (B,) bool, and whether there is a next observation, (B,) bool.
        """
        reward = self.reward(batch).flatten()
        end = torch.zeros_like(reward) if self.end is None else self.end(batch).flatten()
        # All observations are read at the same times. `--rename_map` leaves the names of paddings as they are.
        past_the_end = next(
            batch[key][:, 1] for key in batch if key.startswith(f"{OBS_STR}.") and key.endswith("_is_pad")
        )
        return reward, end.bool(), ~past_the_end


def end_column(config: IQLPolicyConfig, dataset_meta: LeRobotDatasetMetadata) -> str | None:
    """The dataset's column that says where a task ends; None with `done_key` "never".

    Raises:
        ValueError: The dataset has no such column, or no reward.
    """
    iql, reward_key = config.iql, config.reward_key
    features, known = dataset_meta.features, reward_columns(dataset_meta)
    end = iql.done_key or (DONE if DONE in features else SUCCESS)
    missing = [] if reward_key in known else [reward_key]
    if end != NEVER and end not in {*known, DONE} & features.keys():
        missing.append(iql.done_key or f"{DONE} or {SUCCESS}")
    if missing:
        choice = (
            f"set --policy.reward_key or --policy.iql.done_key to one of {', '.join(known)}, "
            if known
            else ""
        )
        raise ValueError(
            f"{config.type} learns from rewards, but {dataset_meta.repo_id} has no {' and no '.join(missing)}: "
            f"{choice}add the columns to the dataset, or train --policy.type={config.type.replace('iql', 'bc')}, which "
            "needs none."
        )
    return None if end == NEVER else end

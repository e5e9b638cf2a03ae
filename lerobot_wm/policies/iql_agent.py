"""What `wm_iql` and `e2e_iql` share: their agent made from a configuration, and its loss on LeRobot's batches."""

from typing import Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor

from lerobot_wm.constants import DONE, OBS_STATE, REWARD
from lerobot_wm.policies.iql_config import IQLConfig
from lerobot_wm.rl.agent import IQLAgent


def make_agent(
    config: IQLConfig, observation_dim: int, dataset_meta: LeRobotDatasetMetadata | None
) -> IQLAgent:
    """The agent of a policy, its actors' betas noted in `config` when the policy is made new.

    Args:
        config: The policy's configuration.
        observation_dim: O, the size of the heads' input.
        dataset_meta: The dataset to train on; None when a checkpoint is loaded to act.

    Raises:
        ValueError: The dataset has no rewards, or no actor was trained with `config.beta`.
    """
    if dataset_meta is not None:
        missing = [key for key in (REWARD, DONE) if key not in dataset_meta.features]
        if missing:
            raise ValueError(
                f"{config.type} learns from rewards, but {dataset_meta.repo_id} has no {' and no '.join(missing)}: add "
                f"them to the dataset, or train --policy.type={config.type.replace('iql', 'bc')}, which needs none."
            )
    if not config.trained_betas:
        config.trained_betas = list(dict.fromkeys([config.beta, *config.sweep_betas]))
    if config.beta not in config.trained_betas:
        raise ValueError(
            f"No actor of this checkpoint was trained with beta {config.beta:g}; it has actors for betas "
            f"{', '.join(f'{beta:g}' for beta in config.trained_betas)}. Set --policy.beta to one of these, or train "
            f"again with --policy.sweep_betas='[{config.beta:g}]'."
        )
    return IQLAgent(
        observation_dim,
        config.action_dim,
        betas=config.trained_betas,
        hidden_dims=config.hidden_dims,
        dropout=config.dropout,
        expectile=config.expectile,
        discount=config.discount,
        target_rate=config.target_rate,
    )


def batch_loss(
    agent: IQLAgent, observation: Tensor, next_observation: Tensor, action: Tensor, batch: dict[str, Any]
) -> tuple[Tensor, dict[str, float]]:
    """The agent's loss and its parts by name.

    Args:
        agent: The agent.
        observation: The heads' input at t, (B, O).
        next_observation: At t+1, (B, O).
        action: Scaled to [-1, 1], (B, A).
        batch: `next.reward` (B,), `next.done` (B,), `observation.state_is_pad` (B, 2) at t and t+1.
    """
    return agent.loss(
        observation,
        next_observation,
        action,
        reward=batch[REWARD].flatten(),
        terminal=batch[DONE].flatten().bool(),
        has_next=~batch[f"{OBS_STATE}_is_pad"][:, 1],
    )

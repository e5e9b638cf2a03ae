"""What `wm_iql` and `e2e_iql` share: the agent of a configuration, and what LeRobot's batches tell of an action."""

from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_STR
from torch import Tensor, nn

from lerobot_wm.constants import DONE, SUCCESS
from lerobot_wm.policies.common.iql_config import NEVER, IQLConfig
from lerobot_wm.policies.common.rewards import FrameLabel, reward_columns
from lerobot_wm.rl.agent import IQLAgent


def make_agent(config: IQLConfig, observation_dim: int, *, anew: bool) -> IQLAgent:
    """The agent of a policy, its actors' betas noted in `config` when the policy is made new.

    Args:
        config: The policy's configuration.
        observation_dim: O, the size of the heads' input.
        anew: Whether the policy is made new, though its settings may be those of another.

    Raises:
        ValueError: No actor was trained with `config.beta`.
    """
    if anew or not config.trained_betas:
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


class Outcomes(nn.Module):
    """What came of an action, in training: its reward, whether it ended the task, and whether the data goes on.

    A task ends where the configuration's `done_key` is true, and nowhere where that is `NEVER`.

    Args:
        config: The policy's configuration.
        dataset_meta: The dataset to train on; None when a checkpoint is loaded to act.

    Raises:
        ValueError: The dataset lacks the reward, or does not tell where a task ends.
    """

    def __init__(self, config: IQLConfig, dataset_meta: LeRobotDatasetMetadata | None) -> None:
        super().__init__()
        end = DONE if dataset_meta is None else end_column(config, dataset_meta)
        self.reward = FrameLabel(config.reward_key, dataset_meta)
        self.end = None if end is None else FrameLabel(end, dataset_meta)

    def forward(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor]:
        """What `IQLAgent.loss` is told beside observations and action.

        Args:
            batch: `next.reward` (B,) and `next.done` (B,), or `index` (B,) where other columns are read in their place;
                an observation's `_is_pad` (B, 2) at t and t+1.

        Returns:
            Rewards (B,), ends (B,) bool, and where there is a next observation, (B,) bool.
        """
        reward = self.reward(batch).flatten()
        end = torch.zeros_like(reward) if self.end is None else self.end(batch).flatten()
        return reward, end.bool(), ~_past_the_end(batch)


def _past_the_end(batch: dict[str, Any]) -> Tensor:
    """Where t+1 lies beyond the episode, (B,) bool; all observations are read at the same times.

    Names of observations may have been changed by `--rename_map`, which leaves those of their padding as they are.
    """
    names = (key for key in batch if key.startswith(f"{OBS_STR}.") and key.endswith("_is_pad"))
    return batch[next(names)][:, 1]


def end_column(config: IQLConfig, dataset_meta: LeRobotDatasetMetadata) -> str | None:
    """The column that tells where a task ends, None where it never does.

    A dataset without the column, or without the reward, is refused.

    Raises:
        ValueError: The dataset lacks the reward, or does not tell where a task ends.
    """
    features, known = dataset_meta.features, reward_columns(dataset_meta)
    end = config.done_key or (DONE if DONE in features else SUCCESS)
    missing = [] if config.reward_key in known else [config.reward_key]
    told = end == NEVER or end in {*known, DONE} & features.keys()
    missing += [] if told else [config.done_key or f"{DONE} or {SUCCESS}"]
    if missing:
        choice = f"set --policy.reward_key or done_key to one of {', '.join(known)}, " if known else ""
        raise ValueError(
            f"{config.type} learns from rewards, but {dataset_meta.repo_id} has no {' and no '.join(missing)}: "
            f"{choice}add what is missing to the dataset, or train "
            f"--policy.type={config.type.replace('iql', 'bc')}, which needs none."
        )
    return None if end == NEVER else end

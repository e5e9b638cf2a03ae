"""How the heads of a policy learn actions: relative to the measured state, and with noise at test time."""

import zlib
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from torch import Tensor, nn

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.data.tables import frames_on_disk
from lerobot_wm.policies.common.acting_config import ActingConfig
from lerobot_wm.policies.common.features import Statistics, recorded_name, statistics


class RelativeToState(nn.Module):
    """Actions minus the measured state, in the numbers of `ActingConfig.relative_indices`."""

    of_action: Tensor
    of_state: Tensor

    def __init__(self, config: ActingConfig) -> None:
        super().__init__()
        self.register_buffer(
            "of_action", torch.tensor(config.relative_indices, dtype=torch.long), persistent=False
        )
        self.register_buffer(
            "of_state", torch.tensor(config.relative_state_indices, dtype=torch.long), persistent=False
        )

    def forward(self, action: Tensor, state: Tensor) -> Tensor:
        """Actions (B, A), or chunks (B, K, A), relative to proprioception (B, P) at the (first) frame."""
        return self._add(action, state, -1)

    def inverse(self, action: Tensor, state: Tensor) -> Tensor:
        """Undo `forward`."""
        return self._add(action, state, 1)

    def _add(self, action: Tensor, state: Tensor, sign: int) -> Tensor:
        if not len(self.of_action):
            return action
        measured = state[..., self.of_state].to(action.dtype)  # (B, R)
        if action.ndim > state.ndim:
            measured = measured.unsqueeze(-2).expand(*action.shape[:-1], -1)  # (B, K, R)
        return action.index_add(-1, self.of_action, measured, alpha=sign)


def action_range(
    config: ActingConfig, stats: Statistics, dataset_meta: LeRobotDatasetMetadata, chunk_size: int
) -> tuple[Tensor, Tensor]:
    """Lowest and highest actions of a dataset, as the heads learn them: (A,), or of each step of a chunk (K, A)."""
    low, high = (value.repeat(chunk_size, 1) for value in statistics(stats, ACTION, "min", "max"))  # (K, A)
    chosen = config.relative_indices
    if chosen:
        action, state, episode = frames_on_disk(
            dataset_meta, ACTION, recorded_name(OBS_STATE), "episode_index"
        )  # (N, A), (N, A), (N, 1)
        for step in range(min(chunk_size, len(action))):  # a_{t+step} - s_t, within episodes
            together = (episode[step:] == episode[: len(episode) - step]).flatten()
            relative = (action[step:] - state[: len(state) - step])[together][:, chosen]  # (N', R)
            if len(relative):
                low[step, chosen], high[step, chosen] = relative.amin(0), relative.amax(0)
    return (low, high) if chunk_size > 1 else (low[0], high[0])


class RolloutNoise:
    """Gaussian noise, one stream per rollout of a batch, seeded by the rollout's first observation.

    A rollout is therefore repeatable: it does not depend on the other rollouts, their order, or global random numbers.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the streams: the next call begins new rollouts."""
        self._streams: list[torch.Generator] = []

    def __call__(self, like: Tensor, batch: dict[str, Any]) -> Tensor:
        """The next noise of each rollout, of the shape (B, N) of a tensor, given the batch of `select_action`."""
        if len(self._streams) != like.shape[0]:
            self._streams = [torch.Generator().manual_seed(_digest(batch, i)) for i in range(like.shape[0])]
        return torch.stack([torch.randn(like.shape[1], generator=stream) for stream in self._streams]).to(
            like
        )


def _digest(batch: dict[str, Any], i: int) -> int:
    """A number made of every bit of the tensors of row i."""
    digest = 0
    for key in sorted(key for key, value in batch.items() if isinstance(value, Tensor) and value.ndim > 1):
        digest = zlib.crc32(batch[key][i].contiguous().cpu().numpy().tobytes(), digest)
    return digest

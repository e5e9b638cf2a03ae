"""What the configurations of all our policy types have in common, unless they say otherwise."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig

from lerobot_wm.policies.common.features import IDENTITY_NORMALIZATION


@dataclass
class SingleFramesConfig(PreTrainedConfig):
    """A policy that is trained on single frames, and scales what it reads by itself."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict(IDENTITY_NORMALIZATION)
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        others = {
            name: mode
            for name, mode in self.normalization_mapping.items()
            if mode != NormalizationMode.IDENTITY
        }
        if others:
            raise ValueError(
                f"--policy.normalization_mapping={ {name: mode.value for name, mode in others.items()} }: scaling is "
                "part of these models, which know the dataset's statistics, and what LeRobot scales before would be "
                "scaled twice. Leave the flag out."
            )
        if self.n_obs_steps != 1:
            raise ValueError(
                f"--policy.n_obs_steps={self.n_obs_steps}: these policies look at one frame at a time, and a world "
                "model remembers the others. Leave the flag out."
            )

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Single frames."""
        return None

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Single frames."""
        return None

    @property
    def reward_delta_indices(self) -> list[int] | None:
        """Single frames."""
        return None


@dataclass
class CompileConfig(PreTrainedConfig):
    """Base of the configurations whose training launches many small operations.

    Args:
        compile_model: Compile these (`torch.compile`): a world model's recurrence, the networks of a policy on its
            latents. Takes minutes when the training starts; on a GPU they then run as CUDA graphs.
    """

    compile_model: bool = False


def compiled[**Inputs](function: Callable[Inputs, Any]) -> Callable[Inputs, Any]:
    """`function`, compiled when it is first called, and again for inputs of another shape.

    Its noise is drawn by other generators than the plain function's. A GPU runs it as CUDA graphs, whose outputs the
    next call overwrites.
    """
    return torch.compile(function, mode="reduce-overhead", dynamic=False)

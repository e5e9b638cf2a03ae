"""What the configurations of all our policy types have in common, unless they say otherwise."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig

from lerobot_wm.policies.features import IDENTITY_NORMALIZATION


@dataclass
class SingleFramesConfig(PreTrainedConfig):
    """A policy that is trained on single frames, and scales what it reads by itself."""

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: dict(IDENTITY_NORMALIZATION)
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

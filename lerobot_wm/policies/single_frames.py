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

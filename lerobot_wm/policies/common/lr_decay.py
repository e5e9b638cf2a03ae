"""A learning rate that falls to zero at the end, for every configuration that can ask for it."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.common.optim import FinalDecayConfig


@dataclass
class LRDecayConfig(PreTrainedConfig):
    """It comes first among the base classes of a policy's configuration: it sets the schedule.

    Args:
        lr_decay_share: Last part of the training's steps over which the learning rate falls linearly to zero; 0, as in
            the paper: it stays as it is.
    """

    lr_decay_share: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.lr_decay_share <= 1:
            raise ValueError(
                f"lr_decay_share is {self.lr_decay_share:g}; a share of the steps is between 0 and 1."
            )

    def get_scheduler_preset(self) -> FinalDecayConfig | None:
        """A constant rate, with `lr_decay_share` until the last part of the steps."""
        return FinalDecayConfig(share=self.lr_decay_share) if self.lr_decay_share else None

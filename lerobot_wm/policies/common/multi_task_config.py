"""What the configurations of all policies that act have in common."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from lerobot.optim import LRSchedulerConfig

from lerobot_wm.constants import ACTION, OBS_STATE
from lerobot_wm.policies.common.config import SingleFramesConfig
from lerobot_wm.policies.common.features import feature_dim, training_dtype
from lerobot_wm.policies.common.optim import FusedAdamConfig


@dataclass
class MultiTaskConfig(SingleFramesConfig):
    """A policy for one or several tasks: small networks, one-hot task ids, Adam at a constant rate.

    Args:
        hidden_dims: Widths of the hidden layers of every head.
        dropout: Dropout of the actor.
        action_noise: Standard deviation of Gaussian noise on the actions at test time, where the dataset's actions span
            [-1, 1]. Demonstrations that were collected with noise show how to act under it, and a policy that hovers
            where no demonstration ends gets free.
        lr: Learning rate of Adam.
        dtype: Autocast type of training, "bfloat16" or "float32"; None picks what the device is fast in, once: a
            checkpoint keeps it.
        tasks: Task strings in one-hot order, taken from the dataset when the policy is made.
    """

    hidden_dims: list[int] = field(default_factory=lambda: [256, 256])
    dropout: float = 0.1
    action_noise: float = 0.0
    lr: float = 3e-4
    dtype: str | None = None
    tasks: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_noise < 0:
            raise ValueError(f"action_noise is {self.action_noise:g}; a standard deviation is 0 or more.")
        self.dtype = training_dtype(self.dtype, str(self.device))

    @property
    def state_dim(self) -> int:
        """Size of the proprioceptive state."""
        return feature_dim(self.input_features, OBS_STATE)

    @property
    def action_dim(self) -> int:
        """Size of the action."""
        return feature_dim(self.output_features, ACTION)

    def check_tasks(self, names: Iterable[str]) -> None:
        """Refuse tasks that the policy was not trained on.

        Raises:
            ValueError: A task string is not one of its own; names both.
        """
        unknown = set(names) - set(self.tasks)
        if unknown:
            raise ValueError(
                f"Unknown task {sorted(unknown)}; this policy was trained on {self.tasks}. Use one of these strings, "
                "or train it on, by --policy.path, with a dataset that holds the new task."
            )

    def get_optimizer_preset(self) -> FusedAdamConfig:
        """Adam without clipping (IQL reference implementation)."""
        return FusedAdamConfig(lr=self.lr)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """A constant learning rate."""
        return None

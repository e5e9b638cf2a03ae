"""Settings of implicit Q-learning, for every configuration of a policy trained by it."""

from dataclasses import dataclass, field

from lerobot_wm.policies.common.multi_task_config import MultiTaskConfig
from lerobot_wm.policies.common.optim import ActorCosineConfig
from lerobot_wm.policies.common.rewards import RewardConfig

NEVER = "never"  # for `done_key`


@dataclass
class IQLConfig(RewardConfig, MultiTaskConfig):
    """The paper's IQL settings (section 3.1.2), the rest from the IQL reference implementation.

    It comes first among the base classes of a policy's configuration: it sets the schedule and the frames read.

    Args:
        beta: Inverse temperature; it multiplies the advantage. With a 0/1 reward that ends the episode Q and V lie in
            [0, 1], so at 0.5 every weight exp(β·A) lies in [0.61, 1.65]: IQL is then nearly BC. At evaluation it
            picks the actor among `trained_betas`.
        sweep_betas: Further inverse temperatures, an actor each, trained beside the main one on the same critics; 0 is
            behaviour cloning by likelihood. In e2e_iql the image encoder is shaped by the main actor alone.
        expectile: Expectile τ of the value regression.
        discount: γ.
        target_rate: Polyak rate of the target critics.
        done_key: The dataset's column that is true where an action ended the task, not where time ran out. None takes
            next.done or, in a dataset without it, next.success. LeRobot's own recorders set next.done at a time limit,
            too: next.success for these, or next.reward where there is none and the reward is 0/1. "never": no action
            ends it. A reward that is above zero on the way needs this: what ends such a task costs all that would have
            come, and a policy learns to put success off.
        trained_betas: β of every actor, the main one first; filled when the policy is made.
    """

    beta: float = 0.5
    sweep_betas: list[float] = field(default_factory=list)
    expectile: float = 0.7
    discount: float = 0.99
    target_rate: float = 0.005
    done_key: str | None = None
    trained_betas: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.expectile < 1:
            raise ValueError(f"expectile is {self.expectile:g}; it is above 0 and below 1.")
        if not 0 <= self.discount <= 1:
            raise ValueError(f"discount is {self.discount:g}; it is between 0 and 1.")
        if not 0 < self.target_rate <= 1:
            raise ValueError(f"target_rate is {self.target_rate:g}; it is above 0 and at most 1.")
        for beta in (self.beta, *self.sweep_betas):
            if beta < 0:
                raise ValueError(f"beta is {beta:g}; it is 0 or more, for it prefers what has an advantage.")

    @property
    def observation_delta_indices(self) -> list[int]:
        """Observations at t and t+1."""
        return [0, 1]

    def get_scheduler_preset(self) -> ActorCosineConfig:
        """Cosine decay on the actors only."""
        return ActorCosineConfig()

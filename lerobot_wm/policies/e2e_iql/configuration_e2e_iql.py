"""Configuration of multi-task implicit Q-learning from pixels."""

from dataclasses import dataclass, field

from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.constants import REWARD
from lerobot_wm.policies.common.iql import IQLConfig, end_column
from lerobot_wm.policies.common.optim import ActorCosineConfig
from lerobot_wm.policies.e2e.config import E2EConfig


@PreTrainedConfig.register_subclass("e2e_iql")
@dataclass
class E2EIQLConfig(E2EConfig):
    """IQL from pixels with the settings of IQL on latents (paper section 3.2).

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

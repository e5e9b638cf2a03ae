"""Configuration of multi-task implicit Q-learning from pixels."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.common.iql import IQLPolicyConfig
from lerobot_wm.policies.e2e.config import E2EConfig


@PreTrainedConfig.register_subclass("e2e_iql")
@dataclass
class E2EIQLConfig(IQLPolicyConfig, E2EConfig):
    """IQL from pixels with the settings of IQL on latents (paper section 3.2)."""

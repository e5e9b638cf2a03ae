"""Configuration of multi-task implicit Q-learning on world-model latents."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.common.iql import IQLPolicyConfig
from lerobot_wm.policies.latent.config import LatentPolicyConfig


@PreTrainedConfig.register_subclass("wm_iql")
@dataclass
class WMIQLConfig(IQLPolicyConfig, LatentPolicyConfig):
    """IQL on latents (paper section 3.1.2)."""

"""Configuration of multi-task implicit Q-learning on world-model latents."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.common.iql_config import IQLConfig
from lerobot_wm.policies.latent.config import LatentPolicyConfig


@PreTrainedConfig.register_subclass("wm_iql")
@dataclass
class WMIQLConfig(IQLConfig, LatentPolicyConfig):
    """IQL on latents with the paper's settings (section 3.1.2)."""

"""Configuration of multi-task behaviour cloning on world-model latents."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.common.bc import BCPolicyConfig
from lerobot_wm.policies.latent.config import LatentPolicyConfig


@PreTrainedConfig.register_subclass("wm_bc")
@dataclass
class WMBCConfig(BCPolicyConfig, LatentPolicyConfig):
    """Two-layer MLP regressed on the demonstrated actions (paper section 3.1.2)."""

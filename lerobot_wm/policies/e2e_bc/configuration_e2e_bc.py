"""Configuration of multi-task behaviour cloning from pixels."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.common.bc import BCPolicyConfig
from lerobot_wm.policies.e2e.config import E2EConfig


@PreTrainedConfig.register_subclass("e2e_bc")
@dataclass
class E2EBCConfig(BCPolicyConfig, E2EConfig):
    """Image encoder and two-layer MLP regressed on the demonstrated actions (paper section 3.2)."""

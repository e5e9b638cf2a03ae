"""Configuration of multi-task implicit Q-learning on world-model latents."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.latent_config import LatentPolicyConfig
from lerobot_wm.policies.optim import ActorCosineConfig


@PreTrainedConfig.register_subclass("wm_iql")
@dataclass
class WMIQLConfig(LatentPolicyConfig):
    """IQL with the paper's settings (section 3.1.2), the rest from the IQL reference implementation.

    Args:
        beta: Inverse temperature; it multiplies the advantage.
        expectile: Expectile τ of the value regression.
        discount: γ.
        target_rate: Polyak rate of the target critics.
    """

    beta: float = 0.5
    expectile: float = 0.7
    discount: float = 0.99
    target_rate: float = 0.005

    @property
    def observation_delta_indices(self) -> list[int]:
        """s_t and s_{t+1}."""
        return [0, 1]

    def get_scheduler_preset(self) -> ActorCosineConfig:
        """Cosine decay on the actor only."""
        return ActorCosineConfig()

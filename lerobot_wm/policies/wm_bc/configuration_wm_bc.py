"""Configuration of multi-task behaviour cloning on world-model latents."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.common.bc import BCPolicyConfig
from lerobot_wm.policies.latent.config import LatentPolicyConfig


@PreTrainedConfig.register_subclass("wm_bc")
@dataclass
class WMBCConfig(BCPolicyConfig, LatentPolicyConfig):
    """A head regressed on the demonstrated actions, on the latents of a frozen world model (paper section 3.1.2).

    Args:
        finetune_world_model: Trains the world model's encoder and filter together with the head, from windows of
            images. It starts as pretrained. Each step then costs about as much as one of the world model.
        window_length: Frames T of such a window, whose filter starts from the zero state.
        random_crop_pad: Largest random shift of a window's images in fine-tuning, in pixels, the same for all of its
            frames; 0 leaves them.
    """

    finetune_world_model: bool = False
    window_length: int = 16
    random_crop_pad: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.finetune_world_model and not self.use_latent:
            raise ValueError(
                "--policy.finetune_world_model=true, but --policy.use_latent=false leaves the world model out: give "
                "one of the two flags."
            )
        if self.window_length < 1:
            raise ValueError(f"--policy.window_length={self.window_length}: expected at least 1 frame.")

    @property
    def freezes_world_model(self) -> bool:
        """Whether the world model stays as pretrained."""
        return not self.finetune_world_model

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Frames of a window, relative to its first; None for single frames."""
        return list(range(self.window_length)) if self.finetune_world_model else None

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Frames of the chunks that begin in a window; of one chunk; None for single actions."""
        if not self.finetune_world_model:
            return super().action_delta_indices
        return list(range(self.window_length + self.chunk_size - 1))

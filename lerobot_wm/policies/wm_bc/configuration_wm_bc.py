"""Configuration of multi-task behaviour cloning on world-model latents."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_wm.constants import OBS_LATENT
from lerobot_wm.policies.common.bc import BCPolicyConfig
from lerobot_wm.policies.latent.config import LatentPolicyConfig


@PreTrainedConfig.register_subclass("wm_bc")
@dataclass
class WMBCConfig(BCPolicyConfig, LatentPolicyConfig):
    """A head regressed on the demonstrated actions, on the latents of a frozen world model (paper section 3.1.2).

    Args:
        finetune_world_model: Trains the world model's encoder and filter together with the head, from windows of
            images, with `random_crop_pad` shifted all alike. It starts as pretrained. Each step then costs about as
            much as one of the world model.
        window_length: Frames T of such a window, whose filter starts from the zero state.
    """

    finetune_world_model: bool = False
    window_length: int = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.finetune_world_model and not self.use_latent:
            raise ValueError(
                "--policy.finetune_world_model=true, but --policy.use_latent=false leaves the world model out: give "
                "one of the two flags."
            )
        if self.window_length < 1:
            raise ValueError(f"--policy.window_length={self.window_length}: expected at least 1 frame.")

    def validate_features(self) -> None:
        """Also check that the world model can be trained.

        Raises:
            ValueError: It cannot.
        """
        super().validate_features()
        if self.finetune_world_model and self.scales_latents:
            assert self.world_model is not None  # whose latents are scaled
            raise ValueError(
                f"--policy.finetune_world_model=true, but a {self.world_model.type} stays frozen: leave the flag out, "
                "or give --policy.world_model_path of a wm_rssm."
            )

    def check_dataset(self, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Check that there are images for a world model that is trained.

        Raises:
            ValueError: The dataset holds latents.
        """
        super().check_dataset(dataset_meta)
        if self.finetune_world_model and OBS_LATENT in dataset_meta.features:
            raise ValueError(
                f"--policy.finetune_world_model=true trains on images, and {dataset_meta.repo_id} holds latents: give "
                "the dataset that it was encoded from."
            )

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

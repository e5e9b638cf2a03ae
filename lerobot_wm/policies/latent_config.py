"""What the configurations of the policies on world-model latents share."""

from dataclasses import dataclass

from lerobot_wm.constants import OBS_ENV_STATE
from lerobot_wm.nn.conv import IMAGE_SIZE
from lerobot_wm.policies.cameras import ImagePolicyConfig
from lerobot_wm.policies.features import feature_dim
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import BackboneConfig
from lerobot_wm.policies.multi_task_config import MultiTaskConfig
from lerobot_wm.world_model.config import RSSMConfig


@dataclass
class LatentPolicyConfig(ImagePolicyConfig, MultiTaskConfig):
    """A small multi-task policy on [latent, one-hot task, proprioception] (paper section 3.1.2).

    Args:
        world_model_path: Folder or Hub id of a wm_rssm checkpoint, or of a frozen_backbone's that takes its place; its
            frozen weights become part of this policy's.
        use_latent: False leaves the latent out: the blind control, proprioception and task id only.
        use_environment_state: True adds the simulator's full state, `observation.environment_state`: with
            `use_latent=false` the control that is given the truth. The environment has to emit it.
        save_predicted_video: True has `lerobot-eval` write, beside its videos, one of each batch of rollouts
            (`pred_episode_N.mp4`): what the world model expected to see at every step, and on its right what it saw.
        rssm, frozen_backbone: What kind of encoder the policy holds, one of the two; taken from its checkpoint.
        image_key, world_model_fingerprint: Taken from that checkpoint when the policy is made.
    """

    world_model_path: str | None = None
    use_latent: bool = True
    use_environment_state: bool = False
    save_predicted_video: bool = False
    rssm: RSSMConfig | None = None
    frozen_backbone: BackboneConfig | None = None
    world_model_fingerprint: str | None = None

    @property
    def image_size(self) -> tuple[int, int]:
        """As its encoder takes images: a world model at its own size, a backbone at the first camera's."""
        return super().image_size if self.rssm is None else (IMAGE_SIZE, IMAGE_SIZE)

    @property
    def env_state_dim(self) -> int:
        """Size of the simulator's full state; 0 where the policy does not read it."""
        return (
            feature_dim(self.input_features, OBS_ENV_STATE, "The dataset")
            if self.use_environment_state
            else 0
        )

    @property
    def latent_dim(self) -> int:
        """Size of s_t; 0 for a policy without latents."""
        encoder = self.rssm or self.frozen_backbone
        return 0 if encoder is None else encoder.latent_dim

    @property
    def observation_dim(self) -> int:
        """Size of the networks' input: latent, one-hot task, proprioception, full state."""
        return self.latent_dim + len(self.tasks) + self.state_dim + self.env_state_dim

    def validate_features(self) -> None:
        """Check that what the policy reads is there and fits the frozen world model.

        Raises:
            ValueError: A feature is missing, the action has another size than the world model's, or
                `save_predicted_video` is set where nothing predicts.
        """
        _ = self.state_dim, self.env_state_dim
        if self.save_predicted_video and self.rssm is None:
            raise ValueError(
                f"--policy.save_predicted_video=true, but this {self.type} has no world model that predicts images (it "
                "has an image backbone, or no latents): leave the flag out, or take a policy on a wm_rssm's latents."
            )
        if self.rssm is not None and self.rssm.action_dim != self.action_dim:
            raise ValueError(
                f"The world model was trained with {self.rssm.action_dim}-d actions, this dataset or environment has "
                f"{self.action_dim}-d ones: use the one it was trained on, or train another world model."
            )

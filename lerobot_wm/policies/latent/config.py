"""What the configurations of the policies on world-model latents share."""

from collections.abc import Container
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from lerobot_wm.constants import OBS_ENV_STATE
from lerobot_wm.policies.common.cameras import ImagePolicyConfig
from lerobot_wm.policies.common.config import CompileConfig
from lerobot_wm.policies.common.features import feature_dim
from lerobot_wm.policies.common.multi_task_config import MultiTaskConfig
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import FrozenBackboneConfig
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.world_model.config import RSSMConfig


@dataclass
class LatentPolicyConfig(CompileConfig, ImagePolicyConfig, MultiTaskConfig):
    """A small multi-task policy on [latent, one-hot task, proprioception] (paper section 3.1.2).

    Args:
        world_model_path: Folder or Hub id of a world model's checkpoint (wm_rssm), or of a frozen_backbone's that takes
            its place; its frozen weights become part of this policy's.
        use_latent: False leaves the latent out: the blind control, proprioception and task id only.
        use_environment_state: True adds the simulator's full state, `observation.environment_state`: with
            `use_latent=false` the control that is given the truth. The environment has to emit it.
        updates_per_step: Into how many updates a step of `lerobot-wm train` divides its batch, one after the other on
            batch_size / updates_per_step samples each. Of a step of LeRobot's loop, what is not the update takes longer
            than an update of these small networks on a GPU. Schedules move on, and the loss is logged, once a step.
        save_predicted_video: True has `lerobot-eval` write, beside its videos, one of each batch of rollouts
            (`pred_episode_N.mp4`): what the world model expected to see at every step, and on its right what it saw.
        world_model, image_key, world_model_fingerprint: Taken from that checkpoint when the policy is made.
        rssm, frozen_backbone: Read from checkpoints of release 0.1.0, which have one of them in place of `world_model`.
    """

    world_model_path: str | None = None
    use_latent: bool = True
    use_environment_state: bool = False
    updates_per_step: int = 1
    save_predicted_video: bool = False
    world_model: WorldModelConfig | None = None
    world_model_fingerprint: str | None = None
    rssm: RSSMConfig | None = None
    frozen_backbone: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.updates_per_step < 1:
            raise ValueError(f"updates_per_step is {self.updates_per_step}; a step makes 1 or more.")
        if self.rssm is not None or self.frozen_backbone is not None:
            self.world_model = self._world_model_of_0_1_0()
            self.rssm = self.frozen_backbone = None

    def _world_model_of_0_1_0(self) -> WorldModelConfig:
        """What release 0.1.0 wrote down as sizes alone."""
        common: dict[str, Any] = {
            "input_features": deepcopy(self.input_features),
            "output_features": deepcopy(self.output_features),
            "image_key": self.image_key,
            "device": "cpu",
        }
        if self.rssm is not None:
            return WMRSSMConfig(rssm=self.rssm, **common)
        assert self.frozen_backbone is not None  # one of the two
        old = self.frozen_backbone  # name, image_size, n_cameras, latent_dim
        return FrozenBackboneConfig(
            backbone=old["name"],
            backbone_image_size=old["image_size"],
            latent_dim=old["latent_dim"],
            **common,
        )

    @property
    def image_size(self) -> tuple[int, int]:
        """As its world model takes images."""
        return super().image_size if self.world_model is None else self.world_model.image_size

    @property
    def env_state_dim(self) -> int:
        """Size of the simulator's full state; 0 where the policy does not read it."""
        return feature_dim(self.input_features, OBS_ENV_STATE) if self.use_environment_state else 0

    @property
    def latent_dim(self) -> int:
        """Size of s_t; 0 for a policy without latents."""
        return 0 if self.world_model is None else self.world_model.latent_dim

    @property
    def scales_latents(self) -> bool:
        """Whether the policy scales its latents by the dataset's statistics."""
        return self.world_model is not None and self.world_model.scales_latents

    def check_environment_state(self, shown: Container[str]) -> None:
        """Refuse an environment that does not emit the full state which the policy reads.

        Raises:
            ValueError: It is missing among what is `shown`.
        """
        if self.use_environment_state and OBS_ENV_STATE not in shown:
            raise ValueError(
                f"This policy reads '{OBS_ENV_STATE}', which the environment does not emit: evaluate it with "
                "--env.environment_state=true (metaworld_mt), or train one without --policy.use_environment_state."
            )

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
        model = self.world_model
        if self.save_predicted_video and (model is None or not model.predicts_images):
            raise ValueError(
                f"--policy.save_predicted_video=true, but this {self.type} has no world model that predicts images (it "
                f"has {'no latents' if model is None else model.type}): leave the flag out, or take a policy on a "
                "wm_rssm's latents."
            )
        if model is not None and model.action_dim not in (None, self.action_dim):
            raise ValueError(
                f"The world model was trained with {model.action_dim}-d actions, this dataset or environment has "
                f"{self.action_dim}-d ones: use the one it was trained on, or train another world model."
            )

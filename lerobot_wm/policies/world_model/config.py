"""What the configurations of all world models share, and how a policy on their latents keeps one in its own."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import draccus
from lerobot.configs import PreTrainedConfig
from lerobot.optim import LRSchedulerConfig

from lerobot_wm.constants import ACTION
from lerobot_wm.policies.common.cameras import ImagePolicyConfig
from lerobot_wm.policies.common.config import SingleFramesConfig
from lerobot_wm.policies.common.features import feature_dim


@dataclass
class WorldModelConfig(ImagePolicyConfig, SingleFramesConfig):
    """A policy type that makes latents and no actions: a world model, or what stands in its place.

    `--policy.world_model_path` and `lerobot-wm encode` take the checkpoints of every such type. A policy on its latents
    keeps this configuration as its own `world_model`, and makes the module from it again.

    Class attributes: `predicts_images`, whether the module has `expected_images`, which
    `--policy.save_predicted_video=true` shows; `scales_latents`, whether policies scale the latents to unit variance
    by the dataset's statistics, which may be left out where they are in a range of about one as they are.
    """

    predicts_images: ClassVar[bool] = False
    scales_latents: ClassVar[bool] = True

    @property
    @abstractmethod
    def latent_dim(self) -> int:
        """Size of s_t; a subclass may make it a field."""

    @property
    def action_dim(self) -> int | None:
        """Size of the actions that the model reads; None where it reads none."""
        return feature_dim(self.output_features, ACTION)

    def validate_features(self) -> None:
        """Choose the cameras.

        Raises:
            ValueError: They cannot be used.
        """
        self.choose_cameras()

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """A constant learning rate."""
        return None


# What every type has and no module is made from: where it runs, and where it is published.
_NOT_KEPT = {item.name for item in fields(WorldModelConfig)} - {
    "input_features",
    "output_features",
    "image_key",
}


@draccus.encode.register(WorldModelConfig)
def _encode(config: WorldModelConfig, declared_type: type | None = None) -> dict[str, Any]:
    """The configuration as part of a policy's: its type, features and own settings."""
    settings = draccus.encode(config, PreTrainedConfig)
    return {name: value for name, value in settings.items() if name not in _NOT_KEPT}


@draccus.decode.register(WorldModelConfig)
def _decode(settings: dict[str, Any], path: Sequence[str] = ()) -> WorldModelConfig:
    """Undo `_encode`; the module goes where the policy goes, so that no device is chosen here."""
    types = PreTrainedConfig.get_known_choices()
    known = {name: kind for name, kind in types.items() if issubclass(kind, WorldModelConfig)}
    name = settings.get("type")
    if name not in known:
        raise ValueError(
            f"Its world model is of type {name}, which no imported package defines; known are {', '.join(known)}. "
            "Install its package, lerobot_policy_..., or name one on PYTHONPATH by "
            "--policy.discover_packages_path=PACKAGE (--env.discover_packages_path beside --policy.path)."
        )
    own = {key: value for key, value in settings.items() if key != "type"}
    return draccus.decode(known[name], {**own, "device": "cpu"})

"""What the configurations of all world models share, and how a policy on their latents stores one in its own."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import draccus
from lerobot.configs import PreTrainedConfig

from lerobot_wm.policies.common.config import PolicyConfig


@dataclass
class WorldModelConfig(PolicyConfig):
    """A policy type that makes latents and chooses no actions: a world model, or an encoder in its place.

    `--policy.world_model_path` and `lerobot-wm encode` take the checkpoints of every such type. A policy on its latents
    stores this configuration as its own `world_model`, and builds the module from it again.

    Class attributes: `predicts_images`, whether the module has `expected_images`, which
    `--policy.save_predicted_video=true` shows; `scales_latents`, whether policies scale the latents to unit variance by
    the dataset's statistics, which latents with a range of about one do not need.
    """

    chooses_actions: ClassVar[bool] = False
    predicts_images: ClassVar[bool] = False
    scales_latents: ClassVar[bool] = True

    @property
    def proprio_vectors(self) -> list[str]:
        """Feature keys of the vectors that the model reads beside the images, as one."""
        return [key for key in self.state_vectors if key in self.features_read]

    @property
    @abstractmethod
    def latent_dim(self) -> int:
        """Size of s_t; a subclass may make it a field."""

    @property
    def memory_dim(self) -> int:
        """How many numbers of s_t, its first ones, are of the past: `use_memory=false` leaves them out."""
        return 0

    def validate_features(self) -> None:
        """Choose the cameras.

        Raises:
            ValueError: They cannot be used.
        """
        self.choose_cameras()


# What no module is built from: how it is trained, where it runs, and where it is published.
_NOT_STORED = {item.name for item in fields(WorldModelConfig)} - {
    "input_features",
    "output_features",
    "image_key",
    "state_keys",
}


@draccus.encode.register(WorldModelConfig)
def _encode(config: WorldModelConfig, declared_type: type | None = None) -> dict[str, Any]:
    """The configuration as part of a policy's: its type, features and own settings."""
    settings = draccus.encode(config, PreTrainedConfig)
    return {name: value for name, value in settings.items() if name not in _NOT_STORED}


@draccus.decode.register(WorldModelConfig)
def _decode(settings: dict[str, Any], path: Sequence[str] = ()) -> WorldModelConfig:
    """Undo `_encode`. The device is the policy's, so none is chosen here."""
    types = PreTrainedConfig.get_known_choices()
    known = {name: kind for name, kind in types.items() if issubclass(kind, WorldModelConfig)}
    name = settings.get("type")
    if name not in known:
        raise ValueError(
            f"Its world model is of type {name}, which no imported package defines; known are {', '.join(known)}. "
            "Install its package, lerobot_policy_..., or name one on PYTHONPATH with "
            "--policy.discover_packages_path=PACKAGE (--env.discover_packages_path beside --policy.path)."
        )
    own = {key: value for key, value in settings.items() if key != "type"}
    return draccus.decode(known[name], {**own, "device": "cpu"})

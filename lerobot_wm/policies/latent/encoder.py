"""What a latent policy holds and a dataset is encoded with: a world model, or an image backbone in its place."""

from typing import TYPE_CHECKING, Any

from lerobot.policies.factory import get_policy_class

from lerobot_wm.data.latents import weights_fingerprint
from lerobot_wm.policies.common.checkpoint import read_config, split_revision
from lerobot_wm.policies.latent.config import LatentPolicyConfig
from lerobot_wm.policies.world_model.config import WorldModelConfig
from lerobot_wm.world_model.interface import LatentModel

if TYPE_CHECKING:  # a latent policy's module imports this one
    from lerobot_wm.policies.latent.policy import LatentPolicy
    from lerobot_wm.policies.world_model.policy import WorldModelPolicy


type EncoderPolicy = WorldModelPolicy | LatentPolicy


def load_encoder(path: str) -> EncoderPolicy:
    """The checkpoint of an encoder, which it holds as `.world_model`.

    Args:
        path: Folder of a checkpoint of wm_rssm, frozen_backbone or another world model's type, or of a policy on
            latents, which has its encoder in it; or its Hub id: user/name, or user/name@revision for one branch, tag
            or commit.

    Raises:
        ValueError, FileNotFoundError: The checkpoint has no encoder, or is damaged.
    """
    name, revision = split_revision(path)
    config = read_config(name, revision)
    holds_one = isinstance(config, LatentPolicyConfig) and config.use_latent
    if not holds_one and not isinstance(config, WorldModelConfig):
        raise ValueError(
            f"{path} ({config.type}) holds no world model: give a checkpoint of wm_rssm, of another type of world "
            "model or frozen_backbone, or of a policy on their latents such as wm_bc and wm_iql."
        )
    return get_policy_class(config.type).from_pretrained(name, config=config, revision=revision)


def encoder_fingerprint(model: LatentModel, **further: Any) -> str:
    """Hash of an encoder's weights and `encoding_settings`, and of what `further` decides its latents."""
    return weights_fingerprint(model, {**model.encoding_settings, **further})

"""What a latent policy holds and a dataset is encoded with: a world model, or an image backbone in its place."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
from torch import Tensor

from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import FrozenBackboneConfig
from lerobot_wm.policies.latent_config import LatentPolicyConfig
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig

if TYPE_CHECKING:  # a latent policy's module imports this one
    from lerobot_wm.policies.frozen_backbone.modeling_frozen_backbone import FrozenBackbonePolicy
    from lerobot_wm.policies.latent_policy import LatentPolicy
    from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy

type EncoderPolicy = WMRSSMPolicy | FrozenBackbonePolicy | LatentPolicy


class LatentState(Protocol):
    """The state of an encoder after one frame, (B, ·), or after each of T frames, (B, T, ·)."""

    @property
    def latent(self) -> Tensor:
        """s_t, (B, L) or (B, T, L)."""

    def last(self) -> "LatentState":
        """The state after the last of T frames."""


class FrozenEncoder(Protocol):
    """The interface that `WorldModel` and `FrozenBackbone` have in common; both are modules.

    Whole episodes are encoded by `embed` and then `filter_embeds`, a running episode frame by frame by `observe`: the
    latents are the same. Images are (B, T, C, H, W) in [0, 1], several cameras stacked along channels; actions
    (B, T, A) and proprioception (B, T, P) are in the dataset's units. An encoder ignores what it does not read.
    """

    def embed(self, images: Tensor, proprio: Tensor | None = None) -> Tensor:
        """Embeddings e_t, each of its own frame alone: (B, T, E)."""

    def filter_embeds(self, embeds: Tensor, actions: Tensor, *, sample: bool = False) -> LatentState:
        """States for embeddings of whole episodes, given the action a_t executed at each frame."""

    def observe(
        self, images: Tensor, prev_actions: Tensor, state: Any = None, proprio: Tensor | None = None
    ) -> LatentState:
        """States for the next frames, given the action a_{t-1} before each and the state before the first."""


def load_encoder(path: str) -> EncoderPolicy:
    """The checkpoint of an encoder, which it holds as `.world_model`.

    Args:
        path: Folder of a wm_rssm or frozen_backbone checkpoint, or of a policy on latents, which has its encoder in
            it; or its Hub id: user/name, or user/name@revision for one branch, tag or commit.

    Raises:
        ValueError: The checkpoint has no encoder.
    """
    name, revision = path, None
    if "@" in path and not Path(path).is_dir():
        name, revision = path.rsplit("@", 1)
    config = PreTrainedConfig.from_pretrained(name, revision=revision)
    of_encoder = isinstance(config, WMRSSMConfig | FrozenBackboneConfig)
    if not of_encoder and not (isinstance(config, LatentPolicyConfig) and config.use_latent):
        raise ValueError(
            f"{path} is a {config.type} checkpoint with no world model in it; expected one of a wm_rssm or a "
            "frozen_backbone, or of a policy on their latents."
        )
    return get_policy_class(config.type).from_pretrained(name, config=config, revision=revision)

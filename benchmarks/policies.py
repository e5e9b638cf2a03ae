"""Untrained policies for the rows that time decisions and rollouts; speed does not depend on the weights."""

from typing import Any

from lerobot.configs import FeatureType, PolicyFeature

from lerobot_wm.constants import ACTION, ACTION_DIM, MT6, OBS_IMAGE, OBS_STATE, STATE_DIM
from lerobot_wm.envs.tasks import task_description
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.world_model.config import RSSMConfig


def input_features(image_size: int) -> dict[str, PolicyFeature]:
    """Return the features of one camera and proprioception."""
    return {
        OBS_IMAGE: PolicyFeature(type=FeatureType.VISUAL, shape=(3, image_size, image_size)),
        OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,)),
    }


def output_features() -> dict[str, PolicyFeature]:
    """Return the feature of Meta-World's action."""
    return {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,))}


def wm_bc(image_size: int) -> WMBCPolicy:
    """Make a wm_bc with its world model for the six tasks; it scales images of other sizes to 64x64."""
    common: dict[str, Any] = {
        "device": "cpu",
        "push_to_hub": False,
        "input_features": input_features(image_size),
        "output_features": output_features(),
        "image_key": OBS_IMAGE,
    }
    world_model = WMRSSMConfig(rssm=RSSMConfig(image_channels=3, action_dim=ACTION_DIM), **common)
    config = WMBCConfig(world_model=world_model, tasks=[task_description(task) for task in MT6], **common)
    return WMBCPolicy(config).eval()

"""Processors of the frozen backbone, where LeRobot's factory looks for them."""

from lerobot_wm.policies.common.processors import (
    make_pre_post_processors as make_frozen_backbone_pre_post_processors,
)

__all__ = ["make_frozen_backbone_pre_post_processors"]

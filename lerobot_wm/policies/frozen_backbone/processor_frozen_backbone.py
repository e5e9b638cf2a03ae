"""Processors of the frozen backbone, where LeRobot's factory looks for them."""

from lerobot.processor import make_default_pre_post_processors as make_frozen_backbone_pre_post_processors

__all__ = ["make_frozen_backbone_pre_post_processors"]

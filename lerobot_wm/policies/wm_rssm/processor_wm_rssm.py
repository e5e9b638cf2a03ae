"""Processors of the world model, where LeRobot's factory looks for them."""

from lerobot_wm.policies.common.processors import make_pre_post_processors as make_wm_rssm_pre_post_processors

__all__ = ["make_wm_rssm_pre_post_processors"]

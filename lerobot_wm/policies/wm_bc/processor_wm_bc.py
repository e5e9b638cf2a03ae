"""Processors of the behaviour-cloning policy, where LeRobot's factory looks for them."""

from lerobot.processor import make_default_pre_post_processors as make_wm_bc_pre_post_processors

__all__ = ["make_wm_bc_pre_post_processors"]

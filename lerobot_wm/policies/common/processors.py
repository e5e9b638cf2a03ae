"""Pre- and post-processing shared by all our policy types."""

from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors


def make_pre_post_processors(
    config: PreTrainedConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """LeRobot's default steps: batching and device placement before the policy, device placement after it.

    Its normalizers do nothing (`IDENTITY_NORMALIZATION`): scaling is part of our models.
    """
    return make_default_pre_post_processors(config, dataset_stats)

"""Strict loading of checkpoints."""

from typing import Any, Self

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from safetensors import SafetensorError


class StrictPolicy(PreTrainedPolicy):
    """A LeRobot policy whose checkpoints must match to the last key and hold finite numbers."""

    # LeRobot insists on both for every class; each policy type sets its own.
    config_class = PreTrainedConfig
    name = "wm"

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: Any, *, strict: bool = True, **kwargs: Any) -> Self:
        """Load a checkpoint from a folder or the Hub; strict unless told otherwise.

        Raises:
            ValueError: Keys are missing, left over or of another shape, or weights are not finite.
        """
        return super().from_pretrained(pretrained_name_or_path, strict=strict, **kwargs)

    @classmethod
    def _load_as_safetensor(cls, model: Self, model_file: str, map_location: str, strict: bool) -> Self:
        try:
            model = super()._load_as_safetensor(model, model_file, map_location, strict)
        except (RuntimeError, SafetensorError) as error:
            raise ValueError(
                f"{model_file} does not fit a {cls.name} of its config.json: {error}. The file was cut short or "
                "belongs to another configuration: copy the checkpoint folder again, whole."
            ) from error
        bad = [name for name, tensor in model.state_dict().items() if not torch.isfinite(tensor).all()]
        if bad:
            raise ValueError(
                f"{model_file} holds NaN or Inf in {', '.join(bad[:3])}{' ...' if len(bad) > 3 else ''}: "
                "the training that wrote it diverged; take an earlier checkpoint."
            )
        return model

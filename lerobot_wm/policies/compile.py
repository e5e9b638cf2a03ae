"""Compiled training steps, for every configuration that can ask for them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig


@dataclass
class CompileConfig(PreTrainedConfig):
    """Base of the configurations whose training launches many small operations.

    Args:
        compile_model: Compile these (`torch.compile`): a world model's recurrence, the networks of a policy on its
            latents. Takes minutes when the training starts; on a GPU they then run as CUDA graphs.
    """

    compile_model: bool = False


def compiled[**Inputs](function: Callable[Inputs, Any]) -> Callable[Inputs, Any]:
    """`function`, compiled when it is first called, and again for inputs of another shape.

    Its noise is drawn by other generators than the plain function's. A GPU runs it as CUDA graphs, whose outputs the
    next call overwrites.
    """
    return torch.compile(function, mode="reduce-overhead", dynamic=False)

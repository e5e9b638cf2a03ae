"""Weights and inputs that are the same on every machine, to compare a policy's output with an earlier release's."""

import torch
from lerobot.policies import PreTrainedPolicy
from torch import Tensor

CAMERAS = ("observation.images.front", "observation.images.wrist")


def waves(shape: tuple[int, ...], start: float = 0.0) -> Tensor:
    """Numbers in [-1, 1] that look random and need no generator, of this shape."""
    count = torch.Size(shape).numel()
    digits = 43758.5453 * torch.sin(start + 12.9898 * torch.arange(count, dtype=torch.float64))
    return (2 * digits.frac().abs() - 1).float().reshape(shape)


@torch.no_grad()
def fill(policy: PreTrainedPolicy) -> None:
    """Give a policy of any type fixed weights of a plausible size; its scalings' scale is 1."""
    for i, (name, tensor) in enumerate(sorted(policy.state_dict().items())):
        if name.endswith((".scale", "running_var")):
            tensor.fill_(1)
        elif tensor.is_floating_point():
            tensor.copy_(waves(tuple(tensor.shape), start=i) * tensor[0].numel() ** -0.5)


@torch.no_grad()
def output(policy: PreTrainedPolicy) -> Tensor:
    """What a policy makes of two frames of two tasks: its actions (2, A), or some of its latents (2, 4)."""
    images = [waves((2, 3, 64, 64), start=i) / 2 + 0.5 for i in range(2)]
    if policy.name in ("wm_rssm", "frozen_backbone"):
        stacked = torch.cat(images, dim=1)[:, None]  # (2, 1, 6, 64, 64)
        return policy.world_model.observe(stacked, torch.zeros(2, 1, 2)).latent[:, 0, -4:]
    policy.reset()
    batch = {
        **dict(zip(CAMERAS, images, strict=True)),
        "observation.state": waves((2, 4)),
        "task": ["Reach", "Push"],
    }
    return policy.select_action(batch)

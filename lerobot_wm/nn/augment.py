"""Image augmentation."""

import torch
from torch import Tensor
from torch.nn import functional as F


def random_crop(images: Tensor, pad: int) -> Tensor:
    """Shift each image by up to `pad` pixels on both axes: pad with its border, crop back at a random place.

    Args:
        images: (N, C, H, W).
        pad: Pixels of replicated border on every side; PTR and DrQ use 4.

    Returns:
        (N, C, H, W), laid out channels-last in memory. Every image has a shift of its own.
    """
    count, _, height, width = images.shape
    padded = F.pad(images, [pad] * 4, mode="replicate")  # (N, C, H + 2·pad, W + 2·pad)
    shifts = torch.randint(2 * pad + 1, (2, count, 1), device=images.device)
    rows = shifts[0] + torch.arange(height, device=images.device)  # (N, H)
    columns = shifts[1] + torch.arange(width, device=images.device)  # (N, W)
    sample = torch.arange(count, device=images.device)[:, None, None]
    crops = padded[sample, :, rows[:, :, None], columns[:, None, :]]  # (N, H, W, C)
    return crops.permute(0, 3, 1, 2)

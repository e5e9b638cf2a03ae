"""Image augmentation."""

import torch
from torch import Tensor, nn
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


_LEVELS = 255  # steps between black and white


def resize_images(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Bring images to another size by antialiased bilinear interpolation; images of this size pass untouched.

    The result is rounded to the 256 levels of a camera, so that it can be stored as uint8 and read back without a
    difference. The aspect ratio is not kept: the whole view is always seen, each axis scaled by itself.

    Args:
        images: (..., C, H, W) in [0, 1].
        size: (H, W) of the result.

    Returns:
        (..., C, *size) in [0, 1], in 256 levels.
    """
    if images.shape[-2:] == size:
        return images
    resized = nn.functional.interpolate(images.flatten(0, -4), size=size, mode="bilinear", antialias=True)
    return ((resized * _LEVELS).round() / _LEVELS).unflatten(0, images.shape[:-3])

"""Operations on images: random shifts, resizing, and stacking of several cameras."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

_LEVELS = 255  # steps between black and white


def channels_first(shape: Sequence[int]) -> tuple[int, int, int]:
    """The (C, H, W) of an image whose channels come first or last: it has fewer channels than rows and columns."""
    first, second, third = shape
    return (first, second, third) if first <= third else (third, first, second)


def random_crop(images: Tensor, pad: int) -> Tensor:
    """Shift each image by up to `pad` pixels on both axes: replicate its border, then crop at a random place.

    Args:
        images: (N, C, H, W).
        pad: Pixels of replicated border on every side; PTR and DrQ use 4.

    Returns:
        (N, C, H, W), channels-last in memory. Each image has its own shift.
    """
    count, _, height, width = images.shape
    padded = F.pad(images, [pad] * 4, mode="replicate")  # (N, C, H + 2·pad, W + 2·pad)
    shifts = torch.randint(2 * pad + 1, (2, count, 1), device=images.device)
    rows = shifts[0] + torch.arange(height, device=images.device)  # (N, H)
    columns = shifts[1] + torch.arange(width, device=images.device)  # (N, W)
    sample = torch.arange(count, device=images.device)[:, None, None]
    crops = padded[sample, :, rows[:, :, None], columns[:, None, :]]  # (N, H, W, C)
    return crops.permute(0, 3, 1, 2)


def resize_images(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize images by antialiased bilinear interpolation; images of the right size are returned unchanged.

    They have a camera's 256 levels before and after, so that storing them as uint8 loses nothing. Each axis is scaled
    by itself: the whole view stays visible, the aspect ratio does not. On a GPU a few values differ by one level.

    Args:
        images: (..., C, H, W) in [0, 1].
        size: (H, W) of the result.

    Returns:
        (..., C, *size) in [0, 1], in steps of 1/255.
    """
    if images.shape[-2:] == size:
        return images
    flat = images.flatten(0, -4)  # (N, C, H, W)
    if images.device.type == "cpu":
        resized = resize_bytes((flat * _LEVELS).round().byte(), size).to(images.dtype) / _LEVELS
    else:  # where whole numbers cannot be interpolated
        resized = F.interpolate(flat, size=size, mode="bilinear", antialias=True)
        resized = (resized * _LEVELS).round() / _LEVELS
    return resized.unflatten(0, images.shape[:-3])


def resize_bytes(images: Tensor, size: tuple[int, int]) -> Tensor:
    """`resize_images` of (N, C, H, W) uint8 on the CPU; fast where channels are last in memory."""
    # With another layout, PyTorch interpolates by other, slower code.
    images = images.contiguous(memory_format=torch.channels_last)
    return F.interpolate(images, size=size, mode="bilinear", antialias=True)


def stack_images(images: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
    """Resize each camera's images (..., C, H, W) and stack them along channels: (..., K·C, *size)."""
    resized = [resize_images(image, size) for image in images]
    return resized[0] if len(resized) == 1 else torch.cat(resized, dim=-3)  # cat would copy a single one


def camera_images(batch: Mapping[str, Tensor], cameras: Sequence[str], size: tuple[int, int]) -> Tensor:
    """The images (..., C, H, W) in [0, 1] of K cameras of a batch, resized and stacked: (..., K·C, *size)."""
    return stack_images([batch[key] for key in cameras], size)


def side_by_side(images: Tensor, n_cameras: int) -> Tensor:
    """Stacked images (..., K·C, H, W) of K cameras as one wide picture each, to look at: (..., C, H, K·W)."""
    return torch.cat(images.chunk(n_cameras, dim=-3), dim=-1)

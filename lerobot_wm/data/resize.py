"""Images of any camera at the size a model takes, the same wherever they are resized: cache, training loop or robot."""

from torch import Tensor, nn

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

"""Images brought to a model's size."""

import numpy as np
import pytest
import torch
from PIL import Image

from lerobot_wm.nn.images import resize_images


def camera_image(height: int, width: int, count: int = 1) -> torch.Tensor:
    """(count, 3, height, width) uint8."""
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (count, 3, height, width), dtype=torch.uint8, generator=generator)


@pytest.mark.parametrize("size", [(96, 128), (48, 48), (480, 480)])
def test_pillow_resizes_alike(size: tuple[int, int]) -> None:
    [image] = camera_image(*size)
    resized = resize_images(image[None] / 255, (64, 64))[0] * 255
    expected = Image.fromarray(image.permute(1, 2, 0).numpy()).resize((64, 64), Image.Resampling.BILINEAR)
    difference = resized - torch.from_numpy(np.array(expected)).permute(2, 0, 1)
    assert difference.abs().max() < 1.01  # Pillow computes in whole numbers


@pytest.mark.parametrize("size", [(96, 128), (48, 48), (128, 128)])
def test_what_is_stored_equals_what_is_resized_on_the_fly(size: tuple[int, int]) -> None:
    """One image alone and windows of many, contiguous or channels last: bit for bit."""
    images = camera_image(*size, count=6)
    stored = (resize_images(images.float() / 255, (64, 64)) * 255).round().to(torch.uint8)
    windows = images.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2).unflatten(0, (2, 3))
    seen = resize_images(windows.float() / 255, (64, 64))
    assert seen.shape == (2, 3, 3, 64, 64)
    assert torch.equal(seen.flatten(0, 1), stored.float() / 255)
    assert torch.equal(resize_images(images[4:5].float() / 255, (64, 64))[0], stored[4].float() / 255)


def test_images_of_the_right_size_are_not_touched() -> None:
    images = torch.rand(2, 5, 3, 64, 64)
    assert resize_images(images, (64, 64)) is images

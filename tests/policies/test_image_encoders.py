import pytest
import torch

from lerobot_wm.nn.images import random_crop
from lerobot_wm.policies.e2e.policy import FEATURE_DIM, ImageEncoder, SpatialEmbeddings


def test_spatial_embeddings_equal_a_plain_loop() -> None:
    torch.manual_seed(0)
    embeddings = SpatialEmbeddings(3, 4, 5, num_features=2)
    features = torch.randn(2, 3, 4, 5)
    expected = torch.zeros(2, 3, 2)
    for n in range(2):
        for c in range(3):
            for f in range(2):
                for y in range(4):
                    for x in range(5):
                        expected[n, c, f] += features[n, c, y, x] * embeddings.kernel[c, y, x, f]
    torch.testing.assert_close(embeddings(features), expected.flatten(1))
    assert embeddings.output_dim == 6


@pytest.mark.parametrize(
    ("name", "image_shape", "feature_map"),
    [
        ("small", (3, 64, 64), (32, 16, 16)),
        ("small", (6, 30, 45), (32, 8, 12)),
        ("resnet18", (3, 64, 64), (512, 8, 8)),
        ("resnet34", (1, 40, 24), (512, 5, 3)),
    ],
)
def test_encoder_shapes(
    name: str, image_shape: tuple[int, int, int], feature_map: tuple[int, int, int]
) -> None:
    encoder = ImageEncoder(name, image_shape)
    assert encoder.embeddings.kernel.shape == (*feature_map, 8)
    features = encoder(torch.rand(2, *image_shape))
    assert features.shape == (2, FEATURE_DIM)
    assert (features.abs() < 1).all()


def test_keypoints_give_the_same_number_of_features() -> None:
    assert ImageEncoder("keypoints", (6, 32, 32))(torch.rand(2, 6, 32, 32)).shape == (2, FEATURE_DIM)


@pytest.mark.parametrize("name", ["small", "resnet18"])
def test_encoder_normalises_by_groups_of_its_own_image_alone(name: str) -> None:
    # BatchNorm, torchvision's default, would tie the images of a batch together.
    torch.manual_seed(0)
    encoder = ImageEncoder(name, (3, 32, 32))
    groups = {m.num_groups for m in encoder.modules() if isinstance(m, torch.nn.GroupNorm)}
    assert groups == {4}
    images = torch.rand(3, 3, 32, 32)
    torch.testing.assert_close(encoder(images)[1:2], encoder(images[1:2]), atol=1e-4, rtol=1e-4)


def test_weights_stay_contiguous() -> None:
    # LeRobot cannot save optimizer states of weights that are channels-last.
    encoder = ImageEncoder("small", (3, 16, 16))
    encoder(torch.rand(2, 3, 16, 16)).sum().backward()
    assert all(p.is_contiguous() and p.grad.is_contiguous() for p in encoder.parameters())


def test_random_crop_is_one_shift_per_image() -> None:
    torch.manual_seed(0)
    pad, size = 2, 6
    image = torch.arange(size * size, dtype=torch.float32).view(1, 1, size, size).repeat(1, 3, 1, 1)
    crops = random_crop(image.expand(64, -1, -1, -1), pad)
    assert crops.shape == (64, 3, size, size)
    # what a shift by (dy, dx) shows: pixels of the image, those at its border repeated
    index = torch.arange(size)
    shifted = {
        (dy, dx): image[0][:, (index + dy).clamp(0, size - 1)][:, :, (index + dx).clamp(0, size - 1)]
        for dy in range(-pad, pad + 1)
        for dx in range(-pad, pad + 1)
    }
    found = {next(shift for shift, view in shifted.items() if torch.equal(view, crop)) for crop in crops}
    assert len(found) > 15  # of 25


def test_random_crop_without_room_changes_nothing() -> None:
    images = torch.rand(2, 3, 5, 7)
    assert torch.equal(random_crop(images, 0), images)

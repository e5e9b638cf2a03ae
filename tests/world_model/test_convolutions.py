import pytest
import torch
from torch import nn

from lerobot_wm.nn.conv import (
    ConvDecoder,
    ConvEncoder,
    UpsamplingConv,
    make_decoder,
    make_encoder,
    mean_places,
)


def test_decoder_equals_its_transposed_convolutions() -> None:
    # The first layer is computed as a matrix product; the layer it stands for gives the same image.
    torch.manual_seed(0)
    decoder = ConvDecoder(16, 3)
    latents = torch.randn(5, 16)
    plain = decoder.layers(decoder.first(decoder.input(latents)[:, :, None, None]))
    torch.testing.assert_close(decoder(latents), plain, atol=1e-5, rtol=1e-4)


def test_shapes() -> None:
    assert ConvEncoder(6)(torch.zeros(2, 6, 64, 64)).shape == (2, 1024)
    assert ConvDecoder(16, 6)(torch.zeros(2, 16)).shape == (2, 6, 64, 64)


@pytest.mark.parametrize("n_keypoints", [0, 5])
@pytest.mark.parametrize("size", [32, 64, 80, 128])
def test_encoder_and_decoder_follow_the_image_size(size: int, n_keypoints: int) -> None:
    encoder = make_encoder(3, size, n_keypoints)
    assert encoder(torch.zeros(2, 3, size, size)).shape == (2, encoder.embed_dim)
    assert make_decoder(16, 3, size, n_keypoints)(torch.zeros(2, 16)).shape == (2, 3, size, size)


def test_keypoints_are_the_columns_and_rows_of_what_each_map_found() -> None:
    maps = torch.zeros(1, 3, 5, 5)
    maps[0, 0, 1, 4] = maps[0, 1, 0, 0] = maps[0, 1, 0, 2] = 50.0  # of the third, every place is equal
    found = mean_places(maps, torch.linspace(-1, 1, 5))  # (1, 6)
    torch.testing.assert_close(found, torch.tensor([[1.0, -0.5, 0.0, -0.5, -1.0, 0.0]]))


@pytest.mark.parametrize("kernel_size", [5, 6])
def test_upsampling_equals_the_transposed_convolution(kernel_size: int) -> None:
    torch.manual_seed(0)
    layer = UpsamplingConv(4, 3, kernel_size)
    plain = nn.ConvTranspose2d(4, 3, kernel_size, stride=2)
    plain.load_state_dict(layer.state_dict())
    ours, theirs = (torch.randn(2, 4, 7, 7, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    ours.requires_grad_(), theirs.requires_grad_()
    torch.testing.assert_close(layer(ours), plain(theirs))
    weight = torch.randn_like(layer(ours))
    (layer(ours) * weight).sum().backward()
    (plain(theirs) * weight).sum().backward()
    for mine, other in ((layer.weight, plain.weight), (layer.bias, plain.bias), (ours, theirs)):
        torch.testing.assert_close(mine.grad, other.grad)

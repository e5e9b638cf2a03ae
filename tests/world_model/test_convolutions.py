import torch

from lerobot_wm.nn.conv import ConvDecoder, ConvEncoder


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


"""Dreamer's image encoder and decoder (Hafner et al. 2019, as laid out in TorchRL), and the same for larger images."""

from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

PAPER_SIZE = 64  # its kernels below fix it: 64-31-14-6-2 down, 1-5-13-30-64 up
_CHANNELS = (32, 64, 128, 256)
_HALVINGS = 2 ** len(_CHANNELS)
ACTIVATIONS = {"relu": nn.ReLU, "elu": nn.ELU}


class _ParityConvTranspose(torch.autograd.Function):
    """A stride-2 transposed convolution, computed as a 3x3 convolution and a pixel shuffle.

    Output pixels with the same parity in x and y see the same taps of the kernel, so the four parities become four
    channels of one ordinary convolution. oneDNN runs it three times faster than the transposed form when there are
    few output channels or few pixels. The backward pass is already fast and stays PyTorch's.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        c_in, c_out, kernel, _ = weight.shape
        padded = F.pad(weight, (0, 6 - kernel, 0, 6 - kernel))  # (C_in, C_out, 6, 6)
        # Tap 2j + r of the kernel adds input q - j to output 2q + r.
        taps = padded.reshape(c_in, c_out, 3, 2, 3, 2).flip(2, 4).permute(1, 3, 5, 0, 2, 4)
        parities = F.conv2d(x, taps.reshape(4 * c_out, c_in, 3, 3), bias.repeat_interleave(4), padding=2)
        out = F.pixel_shuffle(parities, 2)  # (N, C_out, 2H + 4, 2W + 4)
        # Copy the crop: the next activation works in place, which autograd forbids on views.
        return out if kernel == 6 else out[..., :-1, :-1].clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        grad = grads[0].contiguous(memory_format=torch.channels_last)
        stride, padding, dilation, output_padding = [2, 2], [0, 0], [1, 1], [0, 0]
        return torch.ops.aten.convolution_backward(
            grad, x, weight, [weight.shape[1]], stride, padding, dilation, True, output_padding, 1, [True] * 3
        )


class UpsamplingConv(nn.ConvTranspose2d):
    """A stride-2 transposed convolution without padding, kernel 5 or 6, faster on CPUs."""

    def __init__(self, c_in: int, c_out: int, kernel_size: int) -> None:
        super().__init__(c_in, c_out, kernel_size, stride=2)

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]  # output_size is never asked for
        """Map (N, C_in, H, W) to (N, C_out, 2H + k - 2, 2W + k - 2)."""
        if x.device.type != "cpu":
            return super().forward(x)
        bias = self.get_parameter("bias")
        return _ParityConvTranspose.apply(x, self.weight.to(x.dtype), bias.to(x.dtype))


class ConvEncoder(nn.Module):
    """Four convolutions (kernel 4, stride 2), each with an activation: image -> features.

    Padding is 0 for 64x64, as in the paper, and 1 for other sizes, which are halved exactly.
    """

    def __init__(self, image_channels: int, image_size: int = PAPER_SIZE, activation: str = "relu") -> None:
        super().__init__()
        is_paper = image_size == PAPER_SIZE
        self.embed_dim = _CHANNELS[-1] * (2 if is_paper else image_size // _HALVINGS) ** 2  # 1024 for 64x64
        layers: list[nn.Module] = []
        for c_in, c_out in pairwise((image_channels, *_CHANNELS)):
            conv = nn.Conv2d(c_in, c_out, kernel_size=4, stride=2, padding=0 if is_paper else 1)
            layers += [conv, ACTIVATIONS[activation](inplace=True)]
        self.layers = nn.Sequential(*layers)

    def forward(self, images: Tensor) -> Tensor:
        """Map images (N, C, S, S) in [0, 1] to embeddings e_t (N, E)."""
        # channels_last is 1.3-1.5 times faster on CPUs and lets GPUs use tensor cores. The weights keep the default
        # layout: LeRobot cannot save the optimizer state of channels_last weights.
        features = self.layers(images.contiguous(memory_format=torch.channels_last))  # (N, 256, H', W')
        return features.flatten(1)


class KeypointEncoder(nn.Module):
    """Convolutions whose every output map tells where it found its thing: image -> coordinates.

    The softmax over each map of S/4 x S/4 places gives a mean place, its keypoint (Finn et al. 2016, "Deep spatial
    autoencoders"). When an object moves, keypoints move along, wherever it is. Flattened features have other weights
    for each place, and say nothing of places that no training image showed.
    """

    places: Tensor

    def __init__(self, image_channels: int, image_size: int, n_keypoints: int) -> None:
        super().__init__()
        self.embed_dim = 2 * n_keypoints
        layers: list[nn.Module] = []
        for c_in, c_out, kernel, stride in ((image_channels, 32, 4, 2), (32, 64, 4, 2), (64, 64, 3, 1)):
            conv = nn.Conv2d(c_in, c_out, kernel, stride, padding=1)
            layers += [conv, nn.GroupNorm(1, c_out), nn.ReLU(inplace=True)]
        self.layers = nn.Sequential(*layers, nn.Conv2d(64, n_keypoints, kernel_size=1))
        self.register_buffer("places", torch.linspace(-1, 1, image_size // 4), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Map images (N, C, S, S) to the columns and rows of K keypoints, -1 to 1: (N, 2K)."""
        maps = self.layers(images.contiguous(memory_format=torch.channels_last))  # (N, K, S/4, S/4)
        return mean_places(maps.float(), self.places)


def mean_places(maps: Tensor, places: Tensor) -> Tensor:
    """The mean column and row of each map's softmax: maps (N, K, P, P), coordinates of places (P,) -> (N, 2K)."""
    share = maps.flatten(2).softmax(-1).view_as(maps)
    return torch.cat([share.sum(2) @ places, share.sum(3) @ places], dim=-1)


class ConvDecoder(nn.Module):
    """Linear to 1024, then four transposed convolutions (kernels 5, 5, 6, 6, stride 2): latent -> 64x64 image."""

    def __init__(self, latent_dim: int, image_channels: int) -> None:
        super().__init__()
        self.input = nn.Linear(latent_dim, 1024)
        self.first = nn.ConvTranspose2d(1024, 128, kernel_size=5, stride=2)
        self.layers = nn.Sequential(
            nn.ReLU(inplace=True),
            UpsamplingConv(128, 64, kernel_size=5),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(64, 32, kernel_size=6, stride=2),
            nn.ReLU(inplace=True),
            UpsamplingConv(32, image_channels, kernel_size=6),
        )

    def forward(self, latents: Tensor) -> Tensor:
        """Map latents s_t (N, latent_dim) to image means (N, C, 64, 64)."""
        hidden = self.input(latents)  # (N, 1024)
        # On a 1x1 input a transposed convolution is one matrix product, which runs far faster.
        weight = self.first.weight.permute(0, 2, 3, 1).flatten(1)  # (1024, 5·5·128)
        patch = F.linear(hidden, weight.T).unflatten(1, (5, 5, 128)).permute(0, 3, 1, 2)  # (N, 128, 5, 5)
        bias = self.first.get_parameter("bias")  # (128,)
        return self.layers(patch + bias[:, None, None].to(patch.dtype))


class DoublingDecoder(nn.Module):
    """Linear to a map of S/16 x S/16, then four transposed convolutions that double it: latent -> SxS image.

    With `normalize`, each of them follows a GroupNorm.
    """

    def __init__(
        self, latent_dim: int, image_channels: int, image_size: int, normalize: bool = False
    ) -> None:
        super().__init__()
        self.side = image_size // _HALVINGS
        self.input = nn.Linear(latent_dim, _CHANNELS[-1] * self.side**2)
        layers: list[nn.Module] = []
        for c_in, c_out in pairwise((*reversed(_CHANNELS), image_channels)):
            layers += [nn.GroupNorm(1, c_in)] if normalize else []
            layers += [
                nn.ReLU(inplace=True),
                nn.ConvTranspose2d(c_in, c_out, kernel_size=4, stride=2, padding=1),
            ]
        self.layers = nn.Sequential(*layers)

    def forward(self, latents: Tensor) -> Tensor:
        """Map latents s_t (N, latent_dim) to image means (N, C, S, S)."""
        hidden = self.input(latents).unflatten(1, (_CHANNELS[-1], self.side, self.side))
        return self.layers(hidden.contiguous(memory_format=torch.channels_last))


def make_encoder(
    image_channels: int, image_size: int, n_keypoints: int, activation: str = "relu"
) -> ConvEncoder | KeypointEncoder:
    """The paper's encoder, with its activation or another, or an encoder of keypoints."""
    if n_keypoints:
        return KeypointEncoder(image_channels, image_size, n_keypoints)
    return ConvEncoder(image_channels, image_size, activation)


def make_decoder(latent_dim: int, image_channels: int, image_size: int, n_keypoints: int) -> nn.Module:
    """The paper's decoder for 64x64, and one that doubles for other sizes and for keypoints."""
    if image_size == PAPER_SIZE and not n_keypoints:
        return ConvDecoder(latent_dim, image_channels)
    return DoublingDecoder(latent_dim, image_channels, image_size, normalize=n_keypoints > 0)

"""A policy trained from pixels: an image encoder under the heads of the policies on latents."""

from functools import partial
from typing import Any

import torch
import torchvision
from torch import Tensor, nn

from lerobot_wm.nn.conv import KeypointEncoder
from lerobot_wm.nn.images import camera_images, random_crop
from lerobot_wm.policies.common.acting_policy import ActingPolicy
from lerobot_wm.policies.e2e.config import E2EConfig

FEATURE_DIM = 256
N_KEYPOINTS = 64

_GROUPS = 4
_SMALL_CHANNELS = 32
_SMALL_STRIDES = (2, 2, 1, 1)
# PTR's strides are 2, 2, 2, 1, 1 for stem, max pooling and residual stages 2 to 4; torchvision's are 2 everywhere.
# The last two stages keep their resolution, so that 64x64 pixels leave a map of 8x8.
_UNSTRIDED_STAGES = ("layer3", "layer4")


class E2EPolicy(ActingPolicy):
    """Base of `e2e_bc` and `e2e_iql`, which make heads in `build` and define `actor_chunk` and `compute_loss`."""

    config: E2EConfig

    def build(self) -> None:
        """Make the scalings and the image encoder."""
        super().build()
        self.encoder = ImageEncoder(self.config.encoder, self.config.image_shape)

    @property
    def observation_dim(self) -> int:
        """Size of the heads' input: image features, one-hot task, proprioception."""
        return FEATURE_DIM + len(self.config.tasks) + self.config.state_dim

    @property
    def task_start(self) -> int:
        """The one-hot task id follows the image features."""
        return FEATURE_DIM

    def images(self, batch: dict[str, Any]) -> Tensor:
        """The batch's images in [0, 1], resized and stacked: (..., C, H, W)."""
        return camera_images(batch, self.config.cameras, self.config.image_size)

    def observation(self, images: Tensor, state: Tensor, tasks: Tensor) -> Tensor:
        """Encode the images and join the heads' input.

        Args:
            images: The stacked cameras, (B, C, H, W) in [0, 1]; in training with `random_crop_pad` shifted at random,
                all cameras of a frame alike.
            state: Proprioception in the dataset's units, (B, P).
            tasks: One-hot task ids, (B, N).

        Returns:
            [image features, one-hot task, scaled proprioception], (B, O).
        """
        if self.training and self.config.random_crop_pad:
            images = random_crop(images, self.config.random_crop_pad)
        return torch.cat([self.encoder(images), tasks, self.proprioception(state)], dim=-1)

    def observe(self, batch: dict[str, Any], state: Tensor) -> Tensor:
        """Encode the new image; join its features, the one-hot task and proprioception: (B, O)."""
        return self.observation(self.images(batch), state, self.one_hot_tasks(batch, len(state)))


class ImageEncoder(nn.Module):
    """Image -> 256 features in (-1, 1): CNN, learned spatial embeddings or keypoints, linear, LayerNorm, tanh.

    Args:
        name: "small", "keypoints", or torchvision's "resnet18" or "resnet34".
        image_shape: (C, H, W) of the images. The encoder takes no other size.
    """

    def __init__(self, name: str, image_shape: tuple[int, int, int]) -> None:
        super().__init__()
        channels, size, _ = image_shape
        self.backbone: nn.Module
        self.embeddings: nn.Module
        if name == "keypoints":
            self.backbone = keypoints = KeypointEncoder(channels, size, N_KEYPOINTS)
            self.embeddings, n_features = nn.Identity(), keypoints.embed_dim
        else:
            self.backbone = _small(channels) if name == "small" else _resnet(name, channels)
            with torch.no_grad():
                feature_map = self.backbone(torch.zeros(1, *image_shape))  # (1, C', H', W')
            self.embeddings = embeddings = SpatialEmbeddings(*feature_map.shape[1:])
            n_features = embeddings.output_dim
        self.bottleneck = nn.Sequential(
            nn.Linear(n_features, FEATURE_DIM), nn.LayerNorm(FEATURE_DIM), nn.Tanh()
        )

    def forward(self, images: Tensor) -> Tensor:
        """Map images (N, C, H, W) in [0, 1] to features (N, 256)."""
        # Not channels-last as in nn.conv: GroupNorm in bfloat16 is up to seven times slower so on CPUs.
        features = self.backbone(images.contiguous())  # (N, C', H', W')
        return self.bottleneck(self.embeddings(features))


def _small(image_channels: int) -> nn.Sequential:
    """Four 3x3 convolutions of 32 channels: a quarter of the image's resolution."""
    layers: list[nn.Module] = []
    for i, stride in enumerate(_SMALL_STRIDES):
        c_in = _SMALL_CHANNELS if i else image_channels
        layers += [
            nn.Conv2d(c_in, _SMALL_CHANNELS, kernel_size=3, stride=stride, padding=1, bias=False),
            nn.GroupNorm(_GROUPS, _SMALL_CHANNELS),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*layers)


def _resnet(name: str, image_channels: int) -> nn.Sequential:
    """torchvision's ResNet from scratch, with GroupNorm and an eighth of the image's resolution."""
    model = torchvision.models.get_model(name, weights=None, norm_layer=partial(nn.GroupNorm, _GROUPS))
    model.conv1 = nn.Conv2d(image_channels, 64, kernel_size=7, stride=2, padding=3, bias=False)
    for stage in _UNSTRIDED_STAGES:
        first = model.get_submodule(stage)[0]
        first.conv1.stride = first.downsample[0].stride = (1, 1)
    return nn.Sequential(*list(model.children())[:-2])  # without average pooling and classifier


class SpatialEmbeddings(nn.Module):
    """F learned weighted sums over the positions of each channel (PTR, Kumar et al. 2022).

    Average pooling forgets where a feature is. Weights per channel and position keep that, with only C·F outputs.

    Args:
        channels: C of the feature map.
        height: H of the feature map.
        width: W of the feature map.
        num_features: F, the number of weighted sums per channel.
    """

    def __init__(self, channels: int, height: int, width: int, num_features: int = 8) -> None:
        super().__init__()
        self.kernel = nn.Parameter(torch.empty(channels, height, width, num_features))  # (C, H, W, F)
        nn.init.normal_(self.kernel, std=(height * width) ** -0.5)  # one over the fan-in of each sum

    @property
    def output_dim(self) -> int:
        """Number of outputs, C·F."""
        return self.kernel.shape[0] * self.kernel.shape[3]

    def forward(self, features: Tensor) -> Tensor:
        """Map a feature map (N, C, H, W) to (N, C·F)."""
        return torch.einsum("nchw,chwf->ncf", features, self.kernel).flatten(1)

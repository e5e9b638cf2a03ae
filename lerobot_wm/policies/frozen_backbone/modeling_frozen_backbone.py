"""A frozen image backbone as a LeRobot policy: its checkpoint stands in for a world model's."""

import difflib
import pickle
from pathlib import Path
from typing import Any, NoReturn

import torch
import torchvision
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from safetensors.torch import load_file
from torch import Tensor, nn
from torchvision.transforms.v2 import functional as vision

from lerobot_wm.policies.common.features import Statistics
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import (
    RGB_CHANNELS,
    FrozenBackboneConfig,
)
from lerobot_wm.policies.world_model.policy import WorldModelPolicy
from lerobot_wm.world_model.interface import LatentModel, PlainState

# Keys under which published files store the state dict, and prefixes of its keys: R3M has
# {"r3m": {"module.convnet. ..."}}.
CONTAINERS = ("r3m", "state_dict", "model")
PREFIXES = ("module.convnet.", "convnet.", "module.", "backbone.", "model.")
# Layers of models trained to classify, which are left out.
CLASSIFIERS = ("fc.", "classifier.", "head.", "heads.")


def load_backbone_weights(model: nn.Module, path: str) -> None:
    """Load a user's weights into a backbone; the file must have all of its parameters.

    Args:
        model: The backbone without its classifier.
        path: A `.safetensors` file, or a torch file of tensors (read with `weights_only=True`).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a state dict of this model; names what is missing or left over.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"--policy.weights_path={path}: no such file.")
    weights = _strip(_read(file))
    own = model.state_dict()
    missing = sorted(own.keys() - weights.keys())
    left_over = sorted(key for key in weights.keys() - own.keys() if not key.startswith(CLASSIFIERS))
    if missing or left_over:
        raise ValueError(
            f"{path} does not fit the backbone: missing {_some(missing)}, left over {_some(left_over)}. "
            "Set --policy.backbone to the model these weights are of."
        )
    try:
        model.load_state_dict({key: weights[key] for key in own})
    except RuntimeError as error:
        raise ValueError(
            f"{path} does not fit the backbone: {error}. Set --policy.backbone to the model these weights are of."
        ) from error


def _read(file: Path) -> dict[str, Tensor]:
    """The state dict in a file."""
    if file.suffix == ".safetensors":
        return load_file(file)
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise ValueError(
            f"{file} holds more than tensors, and reading it could run unknown code. Save its state dict only: "
            "torch.save(model.state_dict(), ...), or as safetensors."
        ) from error
    for name in CONTAINERS:
        if name in content:
            return content[name]
    return content


def _strip(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Remove the prefix under which a larger model stores its backbone, and that model's other parts."""
    for prefix in PREFIXES:
        if any(key.startswith(prefix) for key in weights):
            return {
                key.removeprefix(prefix): tensor for key, tensor in weights.items() if key.startswith(prefix)
            }
    return weights


def _some(keys: list[str]) -> str:
    return f"{len(keys)} ({', '.join(keys[:3])}{', ...' if len(keys) > 3 else ''})" if keys else "none"


TIMM_PREFIX = "timm/"
# Mean and standard deviation of ImageNet's pixels, which published weights expect (torchvision, timm, R3M).
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class FrozenBackbone(LatentModel):
    """A torchvision or timm model without its classifier, on images with ImageNet's normalisation.

    Its latent is the features of a frame, which depend on that image alone.

    Args:
        name: A classification model of torchvision, or `timm/NAME` for one of timm.
        image_size: Height and width that images are resized to.
        n_cameras: Number of cameras, each encoded separately.
        frame_size: (H, W) of the images it is given; None for `image_size`.

    Raises:
        ValueError: There is no such model, or it takes no images of this size.
        ImportError: timm is needed and not installed.
    """

    def __init__(
        self, name: str, image_size: int, n_cameras: int = 1, frame_size: tuple[int, int] | None = None
    ) -> None:
        super().__init__()
        self.frame_size = frame_size or (image_size, image_size)
        self.name, self.image_size, self.n_cameras = name, image_size, n_cameras
        self.model = make_model(name)
        self.requires_grad_(False).eval()
        self.latent_dim = self._feature_dim()  # of all cameras together

    @property
    def encoding_settings(self) -> dict[str, Any]:
        """Image sizes: pooling networks take any, and their features depend on it and on earlier resizing."""
        settings: dict[str, Any] = {"image_size": self.image_size}
        if self.frame_size != (self.image_size, self.image_size):
            settings["frame_size"] = list(self.frame_size)
        return settings

    def embed(self, images: Tensor, proprio: Tensor | None = None) -> Tensor:
        """Pooled features of K cameras' images (B, T, 3·K, H, W) in [0, 1], camera after camera: (B, T, F)."""
        size = [self.image_size] * 2
        each = images.unflatten(2, (self.n_cameras, RGB_CHANNELS))  # (B, T, K, 3, H, W)
        flat = vision.normalize(
            vision.resize(each.flatten(0, 2), size, antialias=True), list(IMAGENET_MEAN), list(IMAGENET_STD)
        )  # (B·T·K, 3, S, S)
        return self.model(flat).unflatten(0, each.shape[:3]).flatten(2)

    def observe(
        self,
        images: Tensor,
        prev_actions: Tensor,
        state: PlainState | None = None,
        proprio: Tensor | None = None,
    ) -> PlainState:
        """The features of images (B, T, 3·K, H, W) in [0, 1], (B, T, F); see `LatentModel.observe`."""
        return PlainState(self.embed(images))

    def filter_embeds(self, embeds: Tensor, actions: Tensor) -> PlainState:
        """The features themselves, (B, T, F); see `LatentModel.filter_embeds`."""
        return PlainState(embeds)

    @torch.no_grad()
    def _feature_dim(self) -> int:
        """F, found by a forward pass: no table says which image sizes the models take."""
        size = self.image_size
        try:
            features = self.embed(torch.zeros(1, 1, RGB_CHANNELS * self.n_cameras, size, size))
        except (AssertionError, RuntimeError) as error:
            raise ValueError(
                f"{self.name} takes no images of {size}x{size} ({error}): set --policy.backbone_image_size, "
                "224 for most models with fixed positions."
            ) from error
        return features.shape[-1]


def make_model(name: str) -> nn.Module:
    """A randomly initialised backbone that maps normalised images (N, 3, H, W) to pooled features (N, F).

    Raises:
        ValueError: There is no such model, or it has no pooled features.
        ImportError: timm is asked for and not installed.
    """
    if name.startswith(TIMM_PREFIX):
        return _make_timm_model(name.removeprefix(TIMM_PREFIX))
    known = torchvision.models.list_models(module=torchvision.models)
    if name not in known:
        close = difflib.get_close_matches(name, known, n=3)
        raise ValueError(
            f"torchvision has no classification model '{name}'; {'close are' if close else 'it has'} "
            f"{', '.join(close or known)}. timm's are named timm/NAME."
        )
    model = torchvision.models.get_model(name, weights=None)
    # torchvision's classifiers end in a linear layer on pooled features.
    linear = [path for path, module in model.named_modules() if isinstance(module, nn.Linear)]
    if not linear:
        raise ValueError(f"{name} pools class scores, not features: choose another model, such as resnet18.")
    model.set_submodule(linear[-1], nn.Identity())
    return model


def _make_timm_model(name: str) -> nn.Module:
    try:
        import timm
    except ImportError as error:
        raise ImportError(f"--policy.backbone=timm/{name} needs timm: run `pip install timm`.") from error
    if not timm.is_model(name):
        close = difflib.get_close_matches(name, timm.list_models(), n=3)
        raise ValueError(f"timm has no model '{name}'{f'; close are {", ".join(close)}' if close else ''}.")
    return timm.create_model(name, pretrained=False, num_classes=0)


class FrozenBackbonePolicy(WorldModelPolicy):
    """A backbone with a user's weights, or with its random initialisation; it has no training loss."""

    config_class = FrozenBackboneConfig
    name = "frozen_backbone"
    config: FrozenBackboneConfig
    world_model: FrozenBackbone

    def build(self) -> None:
        """Make the backbone."""
        config = self.config
        assert config.backbone_image_size is not None  # chosen by validate_features
        self.world_model = FrozenBackbone(
            config.backbone, config.backbone_image_size, len(config.cameras), config.image_size
        )
        config.latent_dim = self.world_model.latent_dim

    def fit_dataset(self, stats: Statistics, dataset_meta: LeRobotDatasetMetadata) -> None:
        """Load the user's weights; later they are in the checkpoint."""
        if self.config.weights_path is not None:
            load_backbone_weights(self.world_model.model, self.config.weights_path)

    def get_optim_params(self) -> NoReturn:
        """Refuse: nothing is trained."""
        self.config.get_optimizer_preset()

    def compute_loss(self, batch: dict[str, Any]) -> NoReturn:
        """Refuse: nothing is trained."""
        self.config.get_optimizer_preset()

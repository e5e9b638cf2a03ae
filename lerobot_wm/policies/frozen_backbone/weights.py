"""A backbone's weights from a user's file: torchvision's and timm's own layouts, and R3M's."""

import pickle
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

# Where published files keep the state dict, and what its keys begin with: R3M has {"r3m": {"module.convnet. ..."}}.
CONTAINERS = ("r3m", "state_dict", "model")
PREFIXES = ("module.convnet.", "convnet.", "module.", "backbone.", "model.")
CLASSIFIERS = ("fc.", "classifier.", "head.", "heads.")  # of models trained to classify; it is left out


def load_backbone_weights(model: nn.Module, path: str) -> None:
    """Load a user's weights into a backbone: every one of its parameters, from that file.

    Args:
        model: The backbone without its classifier.
        path: A `.safetensors` file, or a torch file of tensors (read with `weights_only=True`).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is no state dict, or not this model's; names what is missing or left over.
    """
    file = Path(path)
    if not file.is_file():
        raise FileNotFoundError(f"--policy.weights_path={path}: there is no such file.")
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
            f"{file} holds more than tensors, and reading it could run foreign code. Save its state dict alone: "
            "torch.save(model.state_dict(), ...), or as safetensors."
        ) from error
    for name in CONTAINERS:
        if name in content:
            return content[name]
    return content


def _strip(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """Without the prefix under which a larger model keeps its backbone, and without that model's other parts."""
    for prefix in PREFIXES:
        if any(key.startswith(prefix) for key in weights):
            return {
                key.removeprefix(prefix): tensor for key, tensor in weights.items() if key.startswith(prefix)
            }
    return weights


def _some(keys: list[str]) -> str:
    return f"{len(keys)} ({', '.join(keys[:3])}{', ...' if len(keys) > 3 else ''})" if keys else "none"

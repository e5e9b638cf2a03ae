"""Content hashes that tie latents to the world model and the dataset they came from."""

import hashlib
from pathlib import Path

from torch import nn

_HEX_DIGITS = 16


def weights_fingerprint(module: nn.Module) -> str:
    """Hash of every parameter and buffer: names, shapes, types and bytes. 16 hexadecimal digits."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:_HEX_DIGITS]


def dataset_fingerprint(root: Path) -> str:
    """Hash of a LeRobotDataset's metadata, tables and videos: relative paths and bytes. 16 hexadecimal digits.

    Args:
        root: The dataset's folder, as in `LeRobotDataset.root`.
    """
    digest = hashlib.sha256()
    for folder in ("meta", "data", "videos"):
        for path in sorted((root / folder).rglob("*")):
            if path.is_file():
                digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
                with path.open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:_HEX_DIGITS]

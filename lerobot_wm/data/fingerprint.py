"""Content hashes that tie latents to the world model and the dataset they came from."""

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from torch import nn

_HEX_DIGITS = 16


def weights_fingerprint(module: nn.Module, settings: Mapping[str, Any] | None = None) -> str:
    """Hash of every parameter and buffer: names, shapes, types and bytes. 16 hexadecimal digits.

    Args:
        module: The module.
        settings: What else decides what it computes.
    """
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    for name, value in sorted((settings or {}).items()):
        digest.update(f"{name} = {value}\n".encode())
    return digest.hexdigest()[:_HEX_DIGITS]


def dataset_fingerprint(root: Path) -> str:
    """Hash of a LeRobotDataset's metadata, tables and videos: relative paths and bytes. 16 hexadecimal digits.

    Args:
        root: The dataset's folder, as in `LeRobotDataset.root`.
    """
    paths = [path for folder in ("meta", "data", "videos") for path in sorted((root / folder).rglob("*"))]
    stats = ((path, path.stat()) for path in paths if path.is_file())
    return _hash_files(root, tuple((path, stat.st_size, stat.st_mtime_ns) for path, stat in stats))


# Each camera and each loader of a run asks, and reading tens of gigabytes takes minutes.
@lru_cache(maxsize=4)
def _hash_files(root: Path, files: tuple[tuple[Path, int, int], ...]) -> str:
    """Hash of the files of a folder: path, size and time of change of each."""
    digest = hashlib.sha256()
    for path, _, _ in files:
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:_HEX_DIGITS]

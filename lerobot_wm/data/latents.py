"""The record a latent dataset carries: which world model and which dataset it was made from."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
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


RECORD_PATH = "meta/latents.json"


@dataclass(frozen=True)
class LatentRecord:
    """Provenance of a latent dataset, kept in its `meta/latents.json`.

    Attributes:
        world_model_fingerprint: `encoder_fingerprint` of the encoding world model.
        source_repo_id: The dataset that was encoded.
        source_fingerprint: `dataset_fingerprint` of it.
        tasks: Its task strings, in order of task_index.
        sampled: False where z_t is the posterior mean, True where it is a sample.
        camera_shapes: (C, H, W) of the cameras that were encoded, as they are in that dataset; none in older records.
        sample_seed: Seed of the samples; None where there are none, and in older records.
    """

    world_model_fingerprint: str
    source_repo_id: str
    source_fingerprint: str
    tasks: list[str]
    sampled: bool
    camera_shapes: dict[str, list[int]] = field(default_factory=dict)
    sample_seed: int | None = None

    @property
    def made_of(self) -> dict[str, str]:
        """What the latents depend on, as far as the record tells."""
        made_of = {
            "world_model_fingerprint": self.world_model_fingerprint,
            "source_fingerprint": self.source_fingerprint,
            "sampled": str(self.sampled),
        }
        if self.sample_seed is not None:
            made_of["sample_seed"] = str(self.sample_seed)
        if self.camera_shapes:
            made_of["cameras"] = ", ".join(self.camera_shapes)
        return made_of

    def write(self, root: Path) -> None:
        """Write the record into the dataset at `root`."""
        (root / RECORD_PATH).write_text(json.dumps(asdict(self), indent=2) + "\n")

    @classmethod
    def read(cls, root: Path) -> "LatentRecord":
        """Read the record of the dataset at `root`.

        Raises:
            ValueError: The dataset carries none, or one that is damaged.
        """
        path = root / RECORD_PATH
        if not path.is_file():
            raise ValueError(
                f"{path} is missing, so nothing tells which world model these latents are of: "
                "encode the dataset again with `lerobot-wm encode`."
            )
        try:
            return cls(**json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise ValueError(
                f"{path} is no record of latents ({error}): it was cut short or damaged; copy the dataset again, "
                "whole, or encode it again with `lerobot-wm encode`."
            ) from error

    def check_world_model(self, fingerprint: str | None, path: str | None) -> None:
        """Refuse latents of another world model.

        Raises:
            ValueError: The fingerprints differ.
        """
        if self.world_model_fingerprint != fingerprint:
            raise ValueError(
                f"These latents were encoded by world model {self.world_model_fingerprint}, but {path} is world model "
                f"{fingerprint}. A policy would act on states it was never trained on: encode {self.source_repo_id} "
                "with this world model, or pass the world model the latents are of."
            )

    def check_cameras(self, cameras: list[str], path: str | None) -> None:
        """Refuse latents of other cameras' images; older records do not tell whose they are.

        Raises:
            ValueError: The cameras differ.
        """
        if self.camera_shapes and list(self.camera_shapes) != cameras:
            raise ValueError(
                f"These latents are of the images of {', '.join(self.camera_shapes)}, but {path} sees "
                f"{', '.join(cameras)}: encode {self.source_repo_id} with this world model."
            )

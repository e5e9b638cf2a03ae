"""Fingerprints of weights and datasets, and the record of a latent dataset: what it was made from."""

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
    """Hash of all parameters and buffers (names, shapes, types, bytes): 16 hexadecimal digits.

    Args:
        module: The module.
        settings: Settings that also decide what it computes.
    """
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}\n".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    for name, value in sorted((settings or {}).items()):
        digest.update(f"{name} = {value}\n".encode())
    return digest.hexdigest()[:_HEX_DIGITS]


def dataset_fingerprint(root: Path) -> str:
    """Hash of a dataset's metadata, tables and videos (relative paths and bytes): 16 hexadecimal digits.

    Args:
        root: The dataset's folder, as in `LeRobotDataset.root`.
    """
    paths = [path for folder in ("meta", "data", "videos") for path in sorted((root / folder).rglob("*"))]
    stats = ((path, path.stat()) for path in paths if path.is_file())
    return _hash_files(root, tuple((path, stat.st_size, stat.st_mtime_ns) for path, stat in stats))


# Each camera and loader of a run asks for it, and reading tens of gigabytes takes minutes.
@lru_cache(maxsize=4)
def _hash_files(root: Path, files: tuple[tuple[Path, int, int], ...]) -> str:
    """Hash of files in a folder, each given as path, size and time of change."""
    digest = hashlib.sha256()
    for path, _, _ in files:
        digest.update(f"{path.relative_to(root).as_posix()}\n".encode())
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:_HEX_DIGITS]


RECORD_PATH = "meta/latents.json"


@dataclass(frozen=True)
class LatentKind:
    """Which latents of images a policy reads.

    Attributes:
        use_memory: Of the filter, s_t = [d_t, z_t]. False encodes each frame by itself, as the first of an episode, and
            keeps z_t alone.
        random_crop_pad: Adds `observation.shifted_latents` (K, L), of each image shifted at random K times by up to so
            many pixels; 0 for none.
    """

    use_memory: bool = True
    random_crop_pad: int = 0


@dataclass(frozen=True)
class LatentRecord:
    """What a latent dataset was made from, stored in its `meta/latents.json`.

    Attributes:
        world_model_fingerprint: `encoder_fingerprint` of the world model.
        source_repo_id: The image dataset.
        source_fingerprint: `dataset_fingerprint` of the image dataset.
        tasks: Task strings in order of task_index.
        camera_shapes: (C, H, W) in the image dataset of each camera that was encoded.
        kind: Which latents they are.
    """

    world_model_fingerprint: str
    source_repo_id: str
    source_fingerprint: str
    tasks: list[str]
    camera_shapes: dict[str, list[int]] = field(default_factory=dict)
    kind: LatentKind = LatentKind()

    @property
    def made_of(self) -> dict[str, str]:
        """All that the latents depend on."""
        return {
            "world_model_fingerprint": self.world_model_fingerprint,
            "source_fingerprint": self.source_fingerprint,
            "cameras": ", ".join(self.camera_shapes),
            **{name: str(value) for name, value in asdict(self.kind).items()},
        }

    def write(self, root: Path) -> None:
        """Write the record into the dataset at `root`."""
        (root / RECORD_PATH).write_text(json.dumps(asdict(self), indent=2) + "\n")

    @classmethod
    def read(cls, root: Path) -> "LatentRecord":
        """Read the record of the dataset at `root`.

        Raises:
            ValueError: The record is missing or damaged.
        """
        path = root / RECORD_PATH
        if not path.is_file():
            raise ValueError(
                f"{path} is missing, which names the world model of these latents; lerobot-edit-dataset does not copy "
                "it. Merge, split or edit the datasets of images instead, and encode the result with `lerobot-wm "
                "encode`."
            )
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            kind = LatentKind(**record.pop("kind", {}))
            # Release 0.2.0 could store samples of z_t.
            return cls(
                kind=kind,
                **{key: value for key, value in record.items() if key not in ("sampled", "sample_seed")},
            )
        except (ValueError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path} is not a record of latents ({error}): it is incomplete or damaged; copy the dataset again, or "
                "encode it again with `lerobot-wm encode`."
            ) from error

    def check_world_model(self, fingerprint: str | None, path: str | None) -> None:
        """Check that the latents are of this world model.

        Raises:
            ValueError: The fingerprints differ.
        """
        if self.world_model_fingerprint != fingerprint:
            raise ValueError(
                f"These latents are of world model {self.world_model_fingerprint}, but {path} is world model "
                f"{fingerprint}: the policy would see different states when it acts. Encode {self.source_repo_id} with "
                "this world model, or give the world model of the latents."
            )

    def check_kind(self, wanted: LatentKind) -> None:
        """Check that these are the latents that a policy reads, or that it can do without their shifted copies.

        Raises:
            ValueError: They are not.
        """
        pad = self.kind.random_crop_pad
        if wanted.use_memory != self.kind.use_memory or wanted.random_crop_pad not in (0, pad):
            raise ValueError(
                f"The policy has --policy.use_memory={wanted.use_memory} and --policy.random_crop_pad="
                f"{wanted.random_crop_pad}, but its latents were encoded with --use_memory={self.kind.use_memory} and "
                f"--random_crop_pad={pad}: encode {self.source_repo_id} with the policy's settings."
            )

    def check_cameras(self, cameras: list[str], path: str | None) -> None:
        """Check that the latents are of these cameras.

        Raises:
            ValueError: The cameras differ.
        """
        if self.camera_shapes and list(self.camera_shapes) != cameras:
            raise ValueError(
                f"These latents are of the cameras {', '.join(self.camera_shapes)}, but {path} sees "
                f"{', '.join(cameras)}: encode {self.source_repo_id} with this world model."
            )

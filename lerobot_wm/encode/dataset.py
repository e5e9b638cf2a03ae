"""A latent dataset from an image dataset and a frozen world model, at once or by several jobs.

Latents of batches of episodes are kept in one file each until all are there: a killed job resumes.
"""

import json
import logging
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import modify_features
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import EPISODES_DIR
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.constants import OBS_LATENT, OBS_SHIFTED_LATENTS
from lerobot_wm.data.cache import cache_root
from lerobot_wm.data.latents import LatentKind, LatentRecord, dataset_fingerprint
from lerobot_wm.data.source import dataset_folder, is_snapshot
from lerobot_wm.data.tables import check_finite_dataset
from lerobot_wm.encode.episodes import embed_episodes, read_episodes
from lerobot_wm.files import appears_whole, sole_writer
from lerobot_wm.policies.common.checks import check_reads
from lerobot_wm.policies.common.features import OWN_NAMES, names_before, policy_features, renamed
from lerobot_wm.policies.latent.policy import (
    EncoderPolicy,
    encoder_config,
    encoder_fingerprint,
    load_encoder,
)
from lerobot_wm.system import quiet
from lerobot_wm.workers import Job, check_same_settings, parts_folder

logger = logging.getLogger(__name__)

# Prefix of latent datasets in the cache of an image dataset.
LATENTS_PREFIX = "latents-"
_EPISODES_PER_BATCH = 16
_SHIFTED_COPIES = 8
_PLAIN = LatentKind()


def episode_batches(dataset: LeRobotDataset) -> list[range]:
    """The batches of episodes in which a dataset is encoded; fixed, because they change the last bits of latents."""
    total = dataset.meta.total_episodes
    return [range(i, min(i + _EPISODES_PER_BATCH, total)) for i in range(0, total, _EPISODES_PER_BATCH)]


@torch.no_grad()
def filter_batches(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    batches: Sequence[range],
    *,
    rename_map: Mapping[str, str] = OWN_NAMES,
    kind: LatentKind = _PLAIN,
) -> Iterator[Tensor]:
    """Encode some batches of a dataset's episodes; images of other episodes are not decoded.

    Args:
        policy: The world model, on its device.
        source: The image dataset.
        batches: Some of its `episode_batches`, in their order.
        rename_map: Names that the world model has for features of the dataset.
        kind: Which latents.

    Yields:
        The latents of each batch, (N, 1, L) float32 on the CPU; with shifted copies (N, 1 + K, L), them last.
    """
    world_model, memory_dim = policy.eval().world_model, encoder_config(policy).memory_dim
    chosen = [episode for batch in batches for episode in batch]
    episodes = read_episodes(
        LeRobotDataset(source.repo_id, source.root, chosen, revision=source.revision),
        names_before(policy.config.cameras, rename_map),
        policy.config.image_size,
        proprio=names_before(encoder_config(policy).proprio_vectors, rename_map),
    )
    start = 0
    for batch in batches:
        of_batch = episodes[start : start + len(batch)]
        start += len(batch)
        copies = []
        with torch.random.fork_rng():
            torch.manual_seed(batch.start)  # the same shifts in a resumed run, and in one of several jobs
            for pad in [0, *[kind.random_crop_pad] * (_SHIFTED_COPIES if kind.random_crop_pad else 0)]:
                embeds, actions = embed_episodes(world_model, of_batch, pad)
                if kind.use_memory:
                    latents = world_model.filter_embeds(embeds, actions).latent  # (B, T, L)
                else:
                    latents = world_model.filter_frames(embeds, actions).latent[..., memory_dim:]
                latents = latents.cpu()
                copies.append(torch.cat([latents[i, : len(each)] for i, each in enumerate(of_batch)]))
        yield torch.stack(copies, dim=1)


@dataclass(frozen=True)
class LatentBatches:
    """A folder of latents with a file `<first>-<last episode>.safetensors`, (N, 1 + K, L), for each batch of episodes.

    Attributes:
        folder: The folder.
        made_of: What the latents depend on; stored in each file, so that different latents are never mixed.
    """

    folder: Path
    made_of: dict[str, str]

    def missing(self, batches: Sequence[range]) -> list[range]:
        """The batches that are not in the folder yet.

        Raises:
            FileExistsError: The folder has latents that depend on anything else.
            ValueError: A file is incomplete.
        """
        for path in sorted(self.folder.glob("*.safetensors")):
            self._check(path)
        return [batch for batch in batches if not self._path(batch).exists()]

    def encode_missing(
        self,
        policy: EncoderPolicy,
        source: LeRobotDataset,
        batches: Sequence[range],
        rename_map: Mapping[str, str],
        kind: LatentKind,
    ) -> None:
        """Encode the batches that are not in the folder yet, see `filter_batches`.

        Raises:
            FileExistsError, ValueError: See `missing`.
            ValueError: Latents are not finite.
        """
        missing = self.missing(batches)
        if len(missing) < len(batches):
            print(f"{len(batches) - len(missing)} of {len(batches)} batches are already in {self.folder}.")
        if not missing:
            return
        first_frames = source.meta.episodes["dataset_from_index"]
        with tqdm(total=sum(map(len, missing)), desc="Encoding", unit="episode") as bar:
            encoded = filter_batches(policy, source, missing, rename_map=rename_map, kind=kind)
            for batch, latents in zip(missing, encoded, strict=True):
                is_finite = latents.isfinite().all(dim=(1, 2))  # (N,)
                if not is_finite.all():
                    row = first_frames[batch.start] + int(is_finite.int().argmin())
                    raise ValueError(
                        f"The world model's latents are not finite from frame {row} of {source.repo_id} on: check its "
                        "weights, and the actions of that episode."
                    )
                with appears_whole(self._path(batch)) as temporary:
                    save_file({OBS_LATENT: latents}, temporary, metadata=self.made_of)
                bar.update(len(batch))

    def read(self, batches: Sequence[range]) -> Tensor:
        """The latents of these batches, (N, 1 + K, L) float32."""
        return torch.cat([load_file(self._path(batch))[OBS_LATENT] for batch in batches])

    def _path(self, batch: range) -> Path:
        return self.folder / f"{batch[0]:06d}-{batch[-1]:06d}.safetensors"

    def _check(self, path: Path) -> None:
        try:
            with safe_open(path, framework="pt") as file:
                found = file.metadata()
        except SafetensorError as error:
            raise ValueError(
                f"{path} is incomplete: copy it again, or remove it to have it encoded again."
            ) from error
        fix = f"use the same flags again, give another --output_root, or remove {self.folder}"
        check_same_settings(found, self.made_of, f"{path} has latents", fix)


def encode(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    output_repo_id: str,
    output_root: Path,
    *,
    rename_map: Mapping[str, str] = OWN_NAMES,
    kind: LatentKind = _PLAIN,
) -> LeRobotDataset:
    """Write a copy of a dataset with `observation.latent` (L,) instead of its cameras.

    The copy records which world model made it (`meta/latents.json`). Latents are first collected in
    `<output_root>.parts`, which may already have some from a killed run or from jobs (`encode_job`).

    Args:
        policy: The frozen world model.
        source: The image dataset, with all of its episodes.
        output_repo_id: Repository id of the result.
        output_root: Folder of the result.
        rename_map: Names that the world model has for features of the dataset.
        kind: Which latents.

    Returns:
        The latent dataset.

    Raises:
        FileExistsError: `output_root` exists already, or `<output_root>.parts` has other latents.
        ValueError: The dataset lacks a camera of the world model or proprioception, or has actions of another size
            than it was trained with, or latents are not finite.
    """
    record, latent_batches = _begin(policy, source, output_root, rename_map, kind)
    batches = episode_batches(source)
    latent_batches.encode_missing(policy, source, batches, rename_map, kind)
    latents, shifted = np.split(latent_batches.read(batches).numpy(), [1], axis=1)  # (N, 1, L), (N, K, L)
    latents = latents[:, 0]  # (N, L), in the dataset's order
    with appears_whole(output_root) as temporary:
        with quiet():
            added = {OBS_LATENT: latents} | ({OBS_SHIFTED_LATENTS: shifted} if kind.random_crop_pad else {})
            features = {
                key: (values, {"dtype": "float32", "shape": values.shape[1:], "names": None})
                for key, values in added.items()
            }
            encoded = modify_features(source, features, source.meta.camera_keys, temporary, output_repo_id)
        _remove_cameras_from_episodes(temporary, source.meta.camera_keys)
        # `modify_features` computes no statistics of new features.
        stats = get_feature_stats(latents, axis=0, keepdims=False)
        write_stats({**encoded.meta.stats, OBS_LATENT: stats}, temporary)
        record.write(temporary)
    shutil.rmtree(latent_batches.folder)
    return LeRobotDataset(output_repo_id, root=output_root)


def _remove_cameras_from_episodes(root: Path, cameras: list[str]) -> None:
    """Remove the columns of cameras from a dataset's table of episodes, where `modify_features` leaves them.

    LeRobot's tools take a dataset with these columns for one that has the videos.
    """
    prefixes = tuple(f"{kind}/{camera}/" for kind in ("videos", "stats") for camera in cameras)
    for path in sorted((root / EPISODES_DIR).glob("*/*.parquet")):
        table = pq.read_table(path)
        kept = [name for name in table.column_names if not name.startswith(prefixes)]
        pq.write_table(table.select(kept), path)


def encode_job(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    output_root: Path,
    job: Job,
    *,
    rename_map: Mapping[str, str] = OWN_NAMES,
    kind: LatentKind = _PLAIN,
) -> None:
    """Encode one job's part of a dataset into `<output_root>.parts`; `encode` makes a dataset of all parts.

    Raises what `encode` does.
    """
    _, latent_batches = _begin(policy, source, output_root, rename_map, kind)
    batches = episode_batches(source)
    latent_batches.encode_missing(policy, source, job.select(batches), rename_map, kind)
    done = len(batches) - len(latent_batches.missing(batches))
    print(
        f"Job {job.index}/{job.count} is done: {done} of {len(batches)} batches are in {latent_batches.folder}. "
        "When all are there, the same command without --shard makes the dataset."
    )


def _begin(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    output_root: Path,
    rename_map: Mapping[str, str],
    kind: LatentKind,
) -> tuple[LatentRecord, LatentBatches]:
    """Check that the dataset can be encoded; returns the record of the result and the place of its latents."""
    folder = parts_folder(output_root)
    record = latent_record(policy, source, rename_map, kind)
    if output_root.exists():
        # A run that was killed at its very end may have left the parts of this very dataset.
        with suppress(ValueError):
            if LatentRecord.read(output_root) == record:
                shutil.rmtree(folder, ignore_errors=True)
        raise FileExistsError(f"{output_root} already exists: choose another --output_root, or remove it.")
    # A policy on latents reads more than its world model does.
    check_reads(encoder_config(policy), source.meta, rename_map)
    names = {"rename_map": json.dumps(dict(rename_map), sort_keys=True)}
    return record, LatentBatches(folder, record.made_of | names)


def latent_record(
    policy: EncoderPolicy, source: LeRobotDataset, rename_map: Mapping[str, str], kind: LatentKind
) -> LatentRecord:
    """The record of the latents that `encode` would make."""
    features = renamed(policy_features(source.meta), rename_map)
    return LatentRecord(
        world_model_fingerprint=encoder_fingerprint(policy.world_model),
        source_repo_id=source.repo_id,
        source_fingerprint=dataset_fingerprint(Path(source.root)),
        tasks=[str(task) for task in source.meta.tasks.index],
        camera_shapes={key: list(features[key].shape) for key in policy.config.cameras if key in features},
        kind=kind,
    )


def encode_to_cache(
    world_model_path: str,
    repo_id: str,
    meta: LeRobotDatasetMetadata,
    device: str,
    rename_map: Mapping[str, str] = OWN_NAMES,
    kind: LatentKind = _PLAIN,
) -> Path:
    """Encode a dataset with a world model into the dataset's cache, unless it is there.

    Args:
        world_model_path: Folder or Hub id of the world model.
        repo_id: Repository id of the image dataset.
        meta: Its metadata.
        device: Device of the world model.
        rename_map: See `encode`.
        kind: See `encode`.

    Returns:
        Folder of the latent dataset.
    """
    policy = load_encoder(world_model_path).to(device)
    root = Path(meta.root)
    # Opened before it is hashed, because only the metadata of a dataset of the Hub may be here yet. A snapshot is
    # opened by name; otherwise its files would be downloaded outside the Hub's cache.
    if is_snapshot(root) and dataset_folder(repo_id, revision=root.name) == root:
        source = LeRobotDataset(repo_id, revision=root.name)
    else:
        source = LeRobotDataset(repo_id, root=root, revision=meta.revision)
    further: dict[str, Any] = {"rename_map": sorted(rename_map.items())} if rename_map else {}
    further |= {name: value for name, value in asdict(kind).items() if value != getattr(_PLAIN, name)}
    fingerprint = encoder_fingerprint(policy.world_model, cameras=policy.config.cameras, **further)
    name = f"{LATENTS_PREFIX}{fingerprint}-{dataset_fingerprint(root)}"
    output_root = cache_root(root) / name
    # Another training may be encoding it.
    with sole_writer(output_root, wait=True):
        if output_root.is_dir():
            logger.info("Latents found in %s", output_root)
        else:
            logger.info("Encoding all %d episodes of %s into %s", meta.total_episodes, repo_id, output_root)
            check_finite_dataset(source)
            encode(policy, source, f"{repo_id}_latents", output_root, rename_map=rename_map, kind=kind)
    return output_root

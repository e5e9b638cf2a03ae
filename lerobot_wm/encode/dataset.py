"""A latent dataset from an image dataset and a frozen world model, at once or by several jobs."""

import json
import logging
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import modify_features
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import EPISODES_DIR

from lerobot_wm.constants import OBS_LATENT
from lerobot_wm.data.cache import cache_root
from lerobot_wm.data.latents import LatentRecord, dataset_fingerprint
from lerobot_wm.data.source import dataset_folder, is_snapshot
from lerobot_wm.data.tables import check_finite_dataset
from lerobot_wm.encode.batches import LatentBatches, episode_batches
from lerobot_wm.files import appears_whole, sole_writer
from lerobot_wm.policies.common.checks import check_reads
from lerobot_wm.policies.common.features import policy_features
from lerobot_wm.policies.common.names import OWN_NAMES, renamed
from lerobot_wm.policies.latent.policy import (
    EncoderPolicy,
    encoder_config,
    encoder_fingerprint,
    load_encoder,
)
from lerobot_wm.system import quiet
from lerobot_wm.workers import Job, parts_folder

logger = logging.getLogger(__name__)

# Prefix of latent datasets in the cache of an image dataset.
LATENTS_PREFIX = "latents-"


def encode(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    output_repo_id: str,
    output_root: Path,
    *,
    rename_map: Mapping[str, str] = OWN_NAMES,
    sample_seed: int | None = None,
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
        sample_seed: Seed to sample z_t with; None stores its mean.

    Returns:
        The latent dataset.

    Raises:
        FileExistsError: `output_root` exists already, or `<output_root>.parts` has other latents.
        ValueError: The dataset lacks a camera of the world model or proprioception, or has actions of another size
            than it was trained with, or latents are not finite.
    """
    record, latent_batches = _begin(policy, source, output_root, rename_map, sample_seed)
    batches = episode_batches(source)
    latent_batches.encode_missing(policy, source, batches, rename_map, sample_seed)
    latents = latent_batches.read(batches).numpy()  # (N, L), in the dataset's order
    with appears_whole(output_root) as temporary:
        with quiet():
            feature = {"dtype": "float32", "shape": latents.shape[1:], "names": None}
            encoded = modify_features(
                source, {OBS_LATENT: (latents, feature)}, source.meta.camera_keys, temporary, output_repo_id
            )
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
    sample_seed: int | None = None,
) -> None:
    """Encode one job's part of a dataset into `<output_root>.parts`; `encode` makes a dataset of all parts.

    Raises what `encode` does.
    """
    _, latent_batches = _begin(policy, source, output_root, rename_map, sample_seed)
    batches = episode_batches(source)
    latent_batches.encode_missing(policy, source, job.select(batches), rename_map, sample_seed)
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
    sample_seed: int | None,
) -> tuple[LatentRecord, LatentBatches]:
    """Check that the dataset can be encoded; returns the record of the result and the place of its latents."""
    folder = parts_folder(output_root)
    record = latent_record(policy, source, rename_map, sample_seed)
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
    policy: EncoderPolicy, source: LeRobotDataset, rename_map: Mapping[str, str], sample_seed: int | None
) -> LatentRecord:
    """The record of the latents that `encode` would make."""
    features = renamed(policy_features(source.meta), rename_map)
    return LatentRecord(
        world_model_fingerprint=encoder_fingerprint(policy.world_model),
        source_repo_id=source.repo_id,
        source_fingerprint=dataset_fingerprint(Path(source.root)),
        tasks=[str(task) for task in source.meta.tasks.index],
        sampled=sample_seed is not None,
        camera_shapes={key: list(features[key].shape) for key in policy.config.cameras if key in features},
        sample_seed=sample_seed,
    )


def encode_to_cache(
    world_model_path: str,
    repo_id: str,
    meta: LeRobotDatasetMetadata,
    device: str,
    rename_map: Mapping[str, str] = OWN_NAMES,
) -> Path:
    """Encode a dataset with a world model into the dataset's cache, unless it is there.

    Args:
        world_model_path: Folder or Hub id of the world model.
        repo_id: Repository id of the image dataset.
        meta: Its metadata.
        device: Device of the world model.
        rename_map: See `encode`.

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
    names: dict[str, Any] = {"rename_map": sorted(rename_map.items())} if rename_map else {}
    fingerprint = encoder_fingerprint(policy.world_model, cameras=policy.config.cameras, **names)
    name = f"{LATENTS_PREFIX}{fingerprint}-{dataset_fingerprint(root)}"
    output_root = cache_root(root) / name
    # Another training may be encoding it.
    with sole_writer(output_root, wait=True):
        if output_root.is_dir():
            logger.info("Latents found in %s", output_root)
        else:
            logger.info("Encoding all %d episodes of %s into %s", meta.total_episodes, repo_id, output_root)
            check_finite_dataset(source)
            encode(policy, source, f"{repo_id}_latents", output_root, rename_map=rename_map)
    return output_root

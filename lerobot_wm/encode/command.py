"""Flags of `lerobot-wm encode`."""

import json
import logging
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import modify_features
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.device_utils import auto_select_torch_device
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_wm.constants import OBS_LATENT, OBS_STATE
from lerobot_wm.data.cache import cache_root
from lerobot_wm.data.latents import LatentRecord, dataset_fingerprint
from lerobot_wm.data.options import SourceConfig
from lerobot_wm.data.source import dataset_folder, is_snapshot
from lerobot_wm.data.tables import check_finite_dataset
from lerobot_wm.encode.episodes import episode_batches
from lerobot_wm.encode.shards import LatentParts
from lerobot_wm.files import sole_writer
from lerobot_wm.hub.dataset_card import license_of, push_latents
from lerobot_wm.hub.errors import check_can_push
from lerobot_wm.policies.common.checks import OWN_NAMES, check_reads, names_before, renamed
from lerobot_wm.policies.frozen_backbone.backbone import FrozenBackbone
from lerobot_wm.policies.latent.policy import EncoderPolicy, LatentPolicy, encoder_fingerprint, load_encoder
from lerobot_wm.quiet import quiet
from lerobot_wm.system import Share, parts_folder, refuse_difference


@dataclass
class EncodeConfig:
    """Flags of `lerobot-wm encode`.

    Args:
        world_model_path: Folder or Hub id (user/name or user/name@revision) of a wm_rssm or frozen_backbone checkpoint,
            or of a policy on latents, which has its own in it.
        dataset: The image dataset.
        output_repo_id: Repository id of the latent dataset.
        output_root: Its folder; must not exist yet.
        sample: Store a sample of z_t instead of its mean.
        seed: Seed of the samples.
        rename_map: The names that the world model knows the dataset's cameras and proprioception by, where they are
            others, as in `lerobot-train`. What the latent dataset keeps of these has the dataset's own names.
        device: Where to run the world model; None picks the fastest there is.
        shard: Of several jobs, the one this is: 1/4 is the first of four. Each job encodes its share of the episodes
            into `<output_root>.parts`; when all are in one such folder, the same command without this flag makes the
            dataset of them. Where machines share a disk, set LEROBOT_WM_CACHE to a folder of its own for each: they
            must not decode frames into one file.
        push_to_hub: Upload the result as `output_repo_id`; also one that was encoded before.
        private: Upload to a private repository.
        license: Licence of the uploaded dataset, as the Hub names it; None takes what the source's card says.
    """

    world_model_path: str
    dataset: SourceConfig
    output_repo_id: str
    output_root: Path
    sample: bool = False
    seed: int = 0
    rename_map: dict[str, str] = field(default_factory=dict)
    device: str | None = None
    shard: str | None = None
    push_to_hub: bool = False
    private: bool = False
    license: str | None = None


logger = logging.getLogger(__name__)

LATENTS_PREFIX = "latents-"  # of the folders in a dataset's cache


def encode(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    output_repo_id: str,
    output_root: Path,
    *,
    rename_map: Mapping[str, str] = OWN_NAMES,
    sample_seed: int | None = None,
) -> LeRobotDataset:
    """Write a copy of `source` with `observation.latent` (L,) in place of its cameras.

    The copy records which world model made it (`meta/latents.json`). Latents are gathered in `<output_root>.parts`,
    which may hold some already: of a run that was killed, or of jobs (`encode_share`). The copy is written beside
    `output_root` and moved there when whole: what lies there is complete.

    Args:
        policy: The frozen world model.
        source: The image dataset, all of its episodes.
        output_repo_id: Repository id of the result.
        output_root: Folder of the result.
        rename_map: The names that the world model knows the source's features by, where they are others.
        sample_seed: Store a sample of z_t, drawn with this seed, instead of its mean.

    Returns:
        The latent dataset.

    Raises:
        FileExistsError: `output_root` is there already, or `<output_root>.parts` holds other latents.
        ValueError: The dataset lacks a camera of the world model or proprioception, or has actions of another size
            than it was trained with, or latents are not finite.
    """
    record, parts = _begin(policy, source, output_root, rename_map, sample_seed)
    batches = episode_batches(source)
    parts.complete(policy, source, batches, rename_map, sample_seed)
    latents = parts.read(batches).numpy()  # (N, L), in the dataset's order
    partial = output_root.with_name(f"{output_root.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    with quiet():
        feature = {"dtype": "float32", "shape": latents.shape[1:], "names": None}
        encoded = modify_features(
            source, {OBS_LATENT: (latents, feature)}, source.meta.camera_keys, partial, output_repo_id
        )
    stats = get_feature_stats(latents, axis=0, keepdims=False)  # modify_features leaves new features out
    write_stats({**encoded.meta.stats, OBS_LATENT: stats}, partial)
    record.write(partial)
    partial.replace(output_root)
    shutil.rmtree(parts.folder)
    return LeRobotDataset(output_repo_id, root=output_root)


def encode_share(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    output_root: Path,
    share: Share,
    *,
    rename_map: Mapping[str, str] = OWN_NAMES,
    sample_seed: int | None = None,
) -> None:
    """One job's share of the latents, in `<output_root>.parts`; `encode` turns those of all jobs into a dataset.

    Raises what `encode` does, and ValueError where there are more jobs than batches.
    """
    _, parts = _begin(policy, source, output_root, rename_map, sample_seed)
    batches = episode_batches(source)
    parts.complete(policy, source, share.of(batches), rename_map, sample_seed)
    there = len(batches) - len(parts.missing(batches))
    print(
        f"Job {share.index}/{share.count} is done: {there} of {len(batches)} batches are in {parts.folder}. "
        "When all are there, the same command without --shard makes the dataset of them."
    )


def _begin(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    output_root: Path,
    rename_map: Mapping[str, str],
    sample_seed: int | None,
) -> tuple[LatentRecord, LatentParts]:
    """Refuse what cannot be encoded; the record of the result, and the place of its latents."""
    parts = parts_folder(output_root)
    if output_root.exists():
        with suppress(ValueError):  # no latents of ours
            if LatentRecord.read(output_root) == _record(policy, source, rename_map, sample_seed):
                shutil.rmtree(parts, ignore_errors=True)  # left by a run killed at its very end
        raise FileExistsError(f"{output_root} is there already: choose another --output_root, or remove it.")
    # Of a policy on latents, only what its world model reads.
    model = policy.config.world_model if isinstance(policy, LatentPolicy) else policy.config
    assert model is not None  # `load_encoder` takes no policy without
    check_reads(model, source.meta, rename_map)
    [state] = names_before([OBS_STATE], rename_map)
    if state not in source.meta.features:
        raise ValueError(
            f"{source.repo_id} has no '{state}', which every policy on latents reads beside them."
        )
    record = _record(policy, source, rename_map, sample_seed)
    names = {"rename_map": json.dumps(dict(rename_map), sort_keys=True)}
    return record, LatentParts(parts, record.made_of | names)


def _record(
    policy: EncoderPolicy, source: LeRobotDataset, rename_map: Mapping[str, str], sample_seed: int | None
) -> LatentRecord:
    features = renamed(dataset_to_policy_features(source.meta.features), rename_map)
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
    """Encode a dataset once for a world model; a second call finds the first one's result.

    Args:
        world_model_path: Folder or Hub id of the world model.
        repo_id: The image dataset's repository id.
        meta: Its metadata.
        device: Where to run the world model.
        rename_map: See `encode`.

    Returns:
        Folder of the latent dataset, in the image dataset's cache.
    """
    policy = load_encoder(world_model_path).to(device)
    root = Path(meta.root)
    # Opened before it is hashed: of a dataset of the Hub only the metadata may be here yet. A snapshot by its name, or
    # the rest would be downloaded past the Hub's cache.
    if is_snapshot(root) and dataset_folder(repo_id, revision=root.name) == root:
        source = LeRobotDataset(repo_id, revision=root.name)
    else:
        source = LeRobotDataset(repo_id, root=root, revision=meta.revision)
    names: dict[str, Any] = {"rename_map": sorted(rename_map.items())} if rename_map else {}
    fingerprint = encoder_fingerprint(policy.world_model, cameras=policy.config.cameras, **names)
    name = f"{LATENTS_PREFIX}{fingerprint}-{dataset_fingerprint(root)}"
    output_root = cache_root(root) / name
    with sole_writer(output_root, wait=True):  # another training may be encoding it
        if output_root.is_dir():
            logger.info("Latents found in %s", output_root)
        else:
            logger.info(
                "Encoding %s, all of its %d episodes, into %s", repo_id, meta.total_episodes, output_root
            )
            check_finite_dataset(source)
            encode(policy, source, f"{repo_id}_latents", output_root, rename_map=rename_map)
    return output_root


def _check_same(found: LatentRecord, expected: LatentRecord, root: Path) -> None:
    there = found.made_of
    here = {
        name: value for name, value in expected.made_of.items() if name in there
    }  # older records tell less
    mend = "choose another --output_root, or remove it"
    refuse_difference(there, here, f"{root} holds latents", mend)


def main() -> None:
    """Entry point of `lerobot-wm encode`."""
    cfg = draccus.parse(EncodeConfig)
    if cfg.push_to_hub:
        check_can_push(cfg.output_repo_id)
    with sole_writer(cfg.output_root, cfg.shard and cfg.shard.replace("/", "-of-")):
        _run(cfg)


def _run(cfg: EncodeConfig) -> None:
    share = Share.parse(cfg.shard) if cfg.shard else None
    policy = load_encoder(cfg.world_model_path)
    policy.to(cfg.device or auto_select_torch_device())
    source = cfg.dataset.open()
    sample_seed = cfg.seed if cfg.sample else None
    if share is not None:
        encode_share(
            policy, source, cfg.output_root, share, rename_map=cfg.rename_map, sample_seed=sample_seed
        )
        return
    if cfg.push_to_hub and cfg.output_root.exists():  # a push that did not finish is begun again
        _check_same(
            LatentRecord.read(cfg.output_root),
            _record(policy, source, cfg.rename_map, sample_seed),
            cfg.output_root,
        )
        dataset = LeRobotDataset(cfg.output_repo_id, root=cfg.output_root)
    else:
        dataset = encode(
            policy,
            source,
            cfg.output_repo_id,
            cfg.output_root,
            rename_map=cfg.rename_map,
            sample_seed=sample_seed,
        )
    print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames -> {cfg.output_root}")
    if cfg.push_to_hub:
        record = LatentRecord.read(cfg.output_root)
        encoder = "image backbone" if isinstance(policy.world_model, FrozenBackbone) else "world model"
        license = cfg.license or license_of(source)
        push_latents(dataset, record, encoder, cfg.world_model_path, cfg.private, license)

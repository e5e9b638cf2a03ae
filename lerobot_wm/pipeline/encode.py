"""`lerobot-wm encode`: filter whole episodes through a frozen world model into a latent LeRobotDataset.

A frozen image backbone may stand in its place: its latents are the pooled features of each frame.
"""

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path

import draccus
import numpy as np
import torch
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import modify_features
from lerobot.datasets.io_utils import write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.device_utils import auto_select_torch_device
from tqdm import tqdm

from lerobot_wm.constants import OBS_LATENT, OBS_STATE
from lerobot_wm.data.cache import cache_root
from lerobot_wm.data.fingerprint import dataset_fingerprint, weights_fingerprint
from lerobot_wm.data.latents import LatentRecord
from lerobot_wm.pipeline.encode_episodes import filter_episodes
from lerobot_wm.pipeline.quiet import quiet
from lerobot_wm.pipeline.source import SourceConfig
from lerobot_wm.policies.frozen_encoder import EncoderPolicy, load_encoder

logger = logging.getLogger(__name__)


@dataclass
class EncodeConfig:
    """Flags of `lerobot-wm encode`.

    Args:
        world_model_path: Folder or Hub id of a wm_rssm or frozen_backbone checkpoint.
        dataset: The image dataset.
        output_repo_id: Repository id of the latent dataset.
        output_root: Its folder; must not exist yet.
        sample: Store a sample of z_t instead of its mean.
        seed: Seed of the samples.
        device: Where to run the world model; None picks the fastest there is.
        push_to_hub: Upload the result as `output_repo_id`.
    """

    world_model_path: str
    dataset: SourceConfig
    output_repo_id: str
    output_root: Path
    sample: bool = False
    seed: int = 0
    device: str | None = None
    push_to_hub: bool = False


def encode(
    policy: EncoderPolicy,
    source: LeRobotDataset,
    output_repo_id: str,
    output_root: Path,
    *,
    sample: bool = False,
) -> LeRobotDataset:
    """Write a copy of `source` with `observation.latent` (L,) in place of its cameras.

    The copy records which world model made it (`meta/latents.json`). It is written beside `output_root` and
    moved there when whole: what lies there is complete.

    Args:
        policy: The frozen world model.
        source: The image dataset, all of its episodes.
        output_repo_id: Repository id of the result.
        output_root: Folder of the result.
        sample: Store a sample of z_t instead of its mean.

    Returns:
        The latent dataset.

    Raises:
        FileExistsError: `output_root` is there already.
        ValueError: The dataset lacks a camera of the world model or proprioception, or latents are not finite.
    """
    if output_root.exists():
        raise FileExistsError(f"{output_root} is there already: choose another --output_root, or remove it.")
    missing = [key for key in policy.config.cameras if key not in source.meta.camera_keys]
    if missing:
        raise ValueError(
            f"The world model watches {', '.join(missing)}; {source.repo_id} has the cameras "
            f"{', '.join(source.meta.camera_keys) or 'none'}: use a dataset with all it watches."
        )
    if OBS_STATE not in source.meta.features:
        raise ValueError(
            f"{source.repo_id} has no '{OBS_STATE}', which every policy on latents reads beside them."
        )
    episodes = filter_episodes(policy, source, sample=sample)
    progress = tqdm(episodes, total=source.num_episodes, desc="Encoding", unit="episode")
    latents = torch.cat(list(progress)).numpy()  # (N, L), in the dataset's order
    if not np.isfinite(latents).all():
        row = int(np.isfinite(latents).all(axis=1).argmin())
        raise ValueError(
            f"The world model's latents are not finite from frame {row} of {source.repo_id} on: "
            "its weights or the actions there are broken."
        )
    partial = output_root.with_name(f"{output_root.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    with quiet():
        feature = {"dtype": "float32", "shape": latents.shape[1:], "names": None}
        encoded = modify_features(
            source, {OBS_LATENT: (latents, feature)}, source.meta.camera_keys, partial, output_repo_id
        )
    stats = get_feature_stats(latents, axis=0, keepdims=False)  # modify_features leaves new features out
    write_stats({**encoded.meta.stats, OBS_LATENT: stats}, partial)
    LatentRecord(
        world_model_fingerprint=weights_fingerprint(policy.world_model),
        source_repo_id=source.repo_id,
        source_fingerprint=dataset_fingerprint(Path(source.root)),
        tasks=[str(task) for task in source.meta.tasks.index],
        sampled=sample,
    ).write(partial)
    partial.replace(output_root)
    return LeRobotDataset(output_repo_id, root=output_root)


def encode_to_cache(world_model_path: str, repo_id: str, meta: LeRobotDatasetMetadata, device: str) -> Path:
    """Encode a dataset once for a world model; a second call finds the first one's result.

    Args:
        world_model_path: Folder or Hub id of the world model.
        repo_id: The image dataset's repository id.
        meta: Its metadata.
        device: Where to run the world model.

    Returns:
        Folder of the latent dataset, in the image dataset's cache.
    """
    policy = load_encoder(world_model_path).to(device)
    root = Path(meta.root)
    name = f"latents-{weights_fingerprint(policy.world_model)}-{dataset_fingerprint(root)}"
    output_root = cache_root(root) / name
    if output_root.is_dir():
        logger.info("Latents found in %s", output_root)
    else:
        logger.info("Encoding %s into %s", repo_id, output_root)
        source = LeRobotDataset(repo_id, root=root, revision=meta.revision)
        encode(policy, source, f"{repo_id}_latents", output_root)
    return output_root


def main() -> None:
    """Entry point of `lerobot-wm encode`."""
    cfg = draccus.parse(EncodeConfig)
    torch.manual_seed(cfg.seed)
    policy = load_encoder(cfg.world_model_path)
    policy.to(cfg.device or auto_select_torch_device())
    dataset = encode(policy, cfg.dataset.open(), cfg.output_repo_id, cfg.output_root, sample=cfg.sample)
    print(f"{dataset.num_episodes} episodes, {dataset.num_frames} frames -> {cfg.output_root}")
    if cfg.push_to_hub:
        dataset.push_to_hub(tags=["lerobot_wm", "latents"])

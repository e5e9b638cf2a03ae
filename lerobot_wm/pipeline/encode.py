"""`lerobot-wm encode`: filter whole episodes through a frozen world model into a latent LeRobotDataset."""

import logging
import shutil
from collections.abc import Iterator
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
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tqdm import tqdm

from lerobot_wm.constants import ACTION, OBS_LATENT, OBS_STATE
from lerobot_wm.data.cache import cache_root, camera_frames
from lerobot_wm.data.fingerprint import dataset_fingerprint, weights_fingerprint
from lerobot_wm.data.latents import LatentRecord
from lerobot_wm.data.tables import column_tensor
from lerobot_wm.pipeline.quiet import quiet
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy, resize_images

logger = logging.getLogger(__name__)

_EPISODES_PER_BATCH = 16
_FRAMES_PER_CHUNK = 512  # images per encoder call: bounds memory whatever the length of the episodes


@dataclass
class SourceConfig:
    """The image dataset: `--dataset.repo_id`, `--dataset.root`, `--dataset.revision` as in `lerobot-train`."""

    repo_id: str
    root: str | None = None
    revision: str | None = None


@dataclass
class EncodeConfig:
    """Flags of `lerobot-wm encode`.

    Args:
        world_model_path: Folder or Hub id of a wm_rssm checkpoint.
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


@torch.no_grad()
def filter_episodes(
    policy: WMRSSMPolicy, dataset: LeRobotDataset, *, sample: bool = False
) -> Iterator[Tensor]:
    """Latents of every episode of `dataset`, a few episodes at a time.

    Args:
        policy: The world model, on the device it shall run on.
        dataset: The image dataset it filters.
        sample: Draw z_t instead of taking its mean.

    Yields:
        For each episode in order, s_t for its frames: (T, D+S) float32 on the CPU.
    """
    policy.eval()
    world_model, device = policy.world_model, policy.world_model.action_scaling.offset.device
    frames = camera_frames(dataset, policy.config.image_key)  # (N, H, W, C) uint8, by absolute index
    columns = {
        key: column_tensor(dataset.hf_dataset, key, tuple(dataset.meta.features[key]["shape"]))
        for key in (
            "episode_index",
            "index",
            ACTION,
            *([OBS_STATE] if policy.config.rssm.use_proprio else []),
        )
    }
    _, lengths = torch.unique_consecutive(columns["episode_index"], return_counts=True)
    stops = lengths.cumsum(0).tolist()
    episodes = [slice(stop - length, stop) for stop, length in zip(stops, lengths.tolist(), strict=True)]

    for begin in range(0, len(episodes), _EPISODES_PER_BATCH):
        batch = episodes[begin : begin + _EPISODES_PER_BATCH]
        embeds = []
        for rows in batch:
            proprio = columns[OBS_STATE][rows].to(device) if policy.config.rssm.use_proprio else None
            chunks = [
                world_model.embed(_images(frames[index], device)[None], _chunk(proprio, i))[0]
                for i, index in enumerate(columns["index"][rows].split(_FRAMES_PER_CHUNK))
            ]
            embeds.append(torch.cat(chunks))  # (T, E)
        # The filter is causal: what pads the shorter episodes comes after their last frame.
        actions = pad_sequence([columns[ACTION][rows] for rows in batch], batch_first=True).to(device)
        states = world_model.filter_embeds(pad_sequence(embeds, batch_first=True), actions, sample=sample)
        for rows, latents in zip(batch, states.latent.cpu(), strict=True):
            yield latents[: rows.stop - rows.start]


def _images(frames: Tensor, device: torch.device) -> Tensor:
    """(T, H, W, C) uint8 -> (T, C, 64, 64) in [0, 1] on the device."""
    return resize_images(frames.to(device).movedim(-1, -3).float() / 255)


def _chunk(proprio: Tensor | None, i: int) -> Tensor | None:
    return None if proprio is None else proprio[i * _FRAMES_PER_CHUNK : (i + 1) * _FRAMES_PER_CHUNK][None]


def encode(
    policy: WMRSSMPolicy,
    source: LeRobotDataset,
    output_repo_id: str,
    output_root: Path,
    *,
    sample: bool = False,
) -> LeRobotDataset:
    """Write a copy of `source` with `observation.latent` (D+S,) in place of its cameras.

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
        ValueError: The dataset lacks the world model's camera, or latents are not finite.
    """
    if output_root.exists():
        raise FileExistsError(f"{output_root} is there already: choose another --output_root, or remove it.")
    if policy.config.image_key not in source.meta.camera_keys:
        raise ValueError(
            f"The world model watches '{policy.config.image_key}'; {source.repo_id} has the cameras "
            f"{source.meta.camera_keys}: use a dataset with that camera."
        )
    episodes = filter_episodes(policy, source, sample=sample)
    progress = tqdm(episodes, total=source.num_episodes, desc="Encoding", unit="episode")
    latents = torch.cat(list(progress)).numpy()  # (N, D+S), in the dataset's order
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
    policy = WMRSSMPolicy.from_pretrained(world_model_path).to(device)
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
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    cfg = draccus.parse(EncodeConfig)
    torch.manual_seed(cfg.seed)
    policy = WMRSSMPolicy.from_pretrained(cfg.world_model_path)
    policy.to(cfg.device or auto_select_torch_device())
    source = LeRobotDataset(cfg.dataset.repo_id, root=cfg.dataset.root, revision=cfg.dataset.revision)
    dataset = encode(policy, source, cfg.output_repo_id, cfg.output_root, sample=cfg.sample)
    logger.info("%d episodes, %d frames -> %s", dataset.num_episodes, dataset.num_frames, cfg.output_root)
    if cfg.push_to_hub:
        dataset.push_to_hub(tags=["lerobot_wm", "latents"])

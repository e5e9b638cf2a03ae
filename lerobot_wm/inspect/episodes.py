"""World models that imagine images, and what they make of recorded episodes."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.encode.episodes import Episode, embed_episodes, read_episodes
from lerobot_wm.policies.common.checks import check_reads
from lerobot_wm.policies.common.config import check_cameras_present
from lerobot_wm.policies.latent.policy import LatentPolicy, encoder_config, load_encoder
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.world_model.model import WorldModel
from lerobot_wm.world_model.rssm import RSSMState

_EPISODES_PER_BATCH = 16

type ImaginingPolicy = WMRSSMPolicy | LatentPolicy


@dataclass
class CheckpointConfig:
    """`--policy.path`, as in `lerobot-eval`."""

    path: str


def load_world_model(path: str) -> ImaginingPolicy:
    """Load a checkpoint that holds an RSSM: wm_rssm, or a policy on its latents. See `load_encoder`.

    Raises:
        ValueError: The checkpoint holds none.
    """
    policy = load_encoder(path)
    if not isinstance(policy, WMRSSMPolicy | LatentPolicy) or not isinstance(policy.world_model, WorldModel):
        raise ValueError(
            f"{path} ({policy.config.type}) holds no world model that imagines images. Give a wm_rssm checkpoint, or a "
            "policy on its latents."
        )
    return policy.eval()


def rssm_of(policy: ImaginingPolicy) -> WorldModel:
    """The policy's world model, which is an RSSM: `load_world_model` accepts no other."""
    assert isinstance(policy.world_model, WorldModel)
    return policy.world_model


def world_model_config(policy: ImaginingPolicy) -> WMRSSMConfig:
    """The configuration that the policy's world model was trained with."""
    config = encoder_config(policy)
    assert isinstance(config, WMRSSMConfig)
    return config


def reward_key(policy: ImaginingPolicy) -> str:
    """The column that the world model's reward head learned; the policy's own `reward_key` may differ."""
    return world_model_config(policy).reward_key


def check_features(policy: ImaginingPolicy, meta: LeRobotDatasetMetadata) -> None:
    """Check that an image dataset has what the policy reads, in the size it was trained on; images may have any size.

    Raises:
        ValueError: A feature is missing or has another size.
    """
    check_reads(policy.config, meta)
    # `check_reads` accepts latents in place of cameras.
    check_cameras_present(policy.config, meta.camera_keys, meta.repo_id)


def check_episodes(meta: LeRobotDatasetMetadata, episodes: Sequence[int]) -> None:
    """Check that a dataset has these episodes, and that there are any.

    Raises:
        ValueError: One does not exist.
    """
    if not episodes or not set(episodes) <= set(range(meta.total_episodes)):
        raise ValueError(
            f"{meta.repo_id} has {meta.total_episodes} episodes, not {list(episodes)}: give some of 0 to "
            f"{meta.total_episodes - 1}."
        )


def episodes_by_task(meta: LeRobotDatasetMetadata, min_length: int = 1) -> dict[str, list[int]]:
    """Indices of each task's episodes of at least `min_length` frames; tasks in the order they occur."""
    found: dict[str, list[int]] = {}
    lengths, tasks = meta.episodes["length"][:], meta.episodes["tasks"][:]
    for index, (length, of_episode) in enumerate(zip(lengths, tasks, strict=True)):
        if length >= min_length:
            found.setdefault(of_episode[0], []).append(index)
    return found


def load_episodes(
    policy: ImaginingPolicy, source: SourceConfig, episodes: list[int], max_frames: int | None = None
) -> list[Episode]:
    """Read episodes of an image dataset with all of their numbers, as the policy's world model is shown them.

    Args:
        policy: The world model, or a policy on it.
        source: Where the dataset is.
        episodes: Indices in ascending order.
        max_frames: How many frames of each to keep, from the first on; None keeps all.
    """
    dataset = LeRobotDataset(source.repo_id, source.root, episodes, revision=source.revision)
    return read_episodes(
        dataset,
        policy.config.cameras,
        policy.config.image_size,
        proprio=world_model_config(policy).proprio_vectors,
        columns=[
            key
            for key, feature in dataset.meta.features.items()
            if key not in dataset.meta.camera_keys and feature["dtype"].startswith(("float", "int", "bool"))
        ],
        max_frames=max_frames,
    )


@dataclass(frozen=True)
class Filtered:
    """The closed loop over one episode of T frames: the filter sees every image; z_t is the posterior mean.

    Attributes:
        states: (T, ·).
        embeds: (T, E).
        kl: KL(posterior || prior) in nats, (T,).
    """

    states: RSSMState
    embeds: Tensor
    kl: Tensor

    @property
    def latents(self) -> Tensor:
        """s_t, (T, D+S)."""
        return self.states.latent


@torch.no_grad()
def filter_episodes(world_model: WorldModel, episodes: list[Episode]) -> list[Filtered]:
    """Filter every episode from its first frame on; results are on the CPU."""
    results = []
    starts = range(0, len(episodes), _EPISODES_PER_BATCH)
    for start in tqdm(starts, desc="Filtering", unit="batch", disable=len(starts) < 2):
        batch = episodes[start : start + _EPISODES_PER_BATCH]
        embeds, actions = embed_episodes(world_model, batch)
        states, kl = world_model.filter_with_kl(embeds, actions)  # (B, T, ·), (B, T)
        for i, episode in enumerate(batch):
            steps = len(episode)
            of_episode = RSSMState(states.deter[i, :steps].cpu(), states.stoch[i, :steps].cpu())
            results.append(Filtered(of_episode, embeds[i, :steps].cpu(), kl[i, :steps].cpu()))
    return results


def imagine(world_model: WorldModel, filtered: list[Filtered], step: int, actions: Tensor) -> Tensor:
    """Imagine what follows frame t of E episodes, z at the prior's mean.

    Args:
        world_model: The model that filtered.
        filtered: Their closed loops.
        step: t, the last frame seen.
        actions: a_t ... a_{t+H-1}, (E, H, A); the action executed at the last frame seen leads to the first imagined.

    Returns:
        s_{t+1} ... s_{t+H}, (E, H, D+S) on the model's device.
    """
    device = world_model.action_scaling.offset.device
    deter = torch.stack([loop.states.deter[step] for loop in filtered])
    stoch = torch.stack([loop.states.stoch[step] for loop in filtered])
    return world_model.imagine(RSSMState(deter.to(device), stoch.to(device)), actions.to(device)).latent

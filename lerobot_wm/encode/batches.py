"""Latents of batches of episodes, kept in one file each until all are there.

Several jobs can share the work, and a killed one resumes.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tqdm import tqdm

from lerobot_wm.constants import ACTION, OBS_LATENT
from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.tables import column_tensor
from lerobot_wm.files import appears_whole
from lerobot_wm.nn.images import stack_images
from lerobot_wm.policies.common.features import join_vectors
from lerobot_wm.policies.common.names import OWN_NAMES, names_before
from lerobot_wm.policies.latent.policy import EncoderPolicy, encoder_config
from lerobot_wm.workers import check_same_settings

_EPISODES_PER_BATCH = 16
# Images per call of the encoder, which bounds memory for long episodes.
_FRAMES_PER_CHUNK = 512


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
    sample_seed: int | None = None,
) -> Iterator[Tensor]:
    """Encode some batches of a dataset's episodes; images of other episodes are not decoded.

    Args:
        policy: The world model, on its device.
        source: The image dataset.
        batches: Some of its `episode_batches`, in their order.
        rename_map: Names that the world model has for features of the dataset.
        sample_seed: Seed to sample z_t with; None takes its mean.

    Yields:
        The latents s_t of each batch, (N, L) float32 on the CPU.
    """
    policy.eval()
    world_model, image_size = policy.world_model, policy.config.image_size
    device = next(world_model.parameters()).device
    episodes = [episode for batch in batches for episode in batch]
    dataset = LeRobotDataset(source.repo_id, source.root, episodes, revision=source.revision)
    # (N, H, W, C) uint8 of each camera, by absolute frame index; the same files as in training.
    camera_keys = names_before(policy.config.cameras, rename_map)
    cameras = [camera_frames(dataset, key, image_size) for key in camera_keys]
    all_lengths = source.meta.episodes["length"][:]
    lengths = [all_lengths[episode] for episode in episodes]

    def by_episode(values: Tensor) -> dict[int, Tensor]:
        return dict(zip(episodes, values.split(lengths), strict=True))

    index = by_episode(_column(dataset, "index").flatten())
    actions = by_episode(_column(dataset, ACTION))
    vectors = names_before(encoder_config(policy).proprio_vectors, rename_map)
    joined = join_vectors({key: _column(dataset, key) for key in vectors}, vectors)
    proprio = None if joined is None else by_episode(joined)
    for batch in batches:
        embeds = []
        for episode in batch:
            chunks = [
                world_model.embed(
                    stack_images(
                        [_images(frames[index[episode][rows]].to(device)) for frames in cameras], image_size
                    )[None],
                    None if proprio is None else proprio[episode][rows][None].to(device),
                )[0]
                for rows in torch.arange(len(index[episode])).split(_FRAMES_PER_CHUNK)
            ]
            embeds.append(torch.cat(chunks))  # (T, E)
        # The filter is causal: padding after the last frame of shorter episodes does not change their latents.
        padded_embeds = pad_sequence(embeds, batch_first=True)  # (B, T, E)
        padded_actions = pad_sequence([actions[episode] for episode in batch], batch_first=True).to(device)
        if sample_seed is not None:
            # A seed for each batch: its samples do not depend on which job encodes it, or after what.
            [seed] = np.random.SeedSequence([sample_seed, batch.start]).generate_state(1)
            torch.manual_seed(int(seed))
        states = world_model.filter_embeds(padded_embeds, padded_actions, sample=sample_seed is not None)
        latents = states.latent.cpu()  # (B, T, L)
        yield torch.cat([latents[i, : len(embed)] for i, embed in enumerate(embeds)])


def _column(dataset: LeRobotDataset, key: str) -> Tensor:
    """(N, *shape)."""
    shape = tuple(dataset.meta.features[key]["shape"])
    return column_tensor(dataset.hf_dataset, key, shape).view(-1, *shape)


def _images(frames: Tensor) -> Tensor:
    """(T, H, W, C) uint8 -> (T, C, H, W) in [0, 1]."""
    return frames.movedim(-1, -3).float() / 255


@dataclass(frozen=True)
class LatentBatches:
    """A folder of latents with a file `<first>-<last episode>.safetensors`, (N, L), for each batch of episodes.

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
        sample_seed: int | None,
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
            encoded = filter_batches(policy, source, missing, rename_map=rename_map, sample_seed=sample_seed)
            for batch, latents in zip(missing, encoded, strict=True):
                is_finite = latents.isfinite().all(dim=1)  # (N,)
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
        """The latents of these batches, (N, L) float32."""
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

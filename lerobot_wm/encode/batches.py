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
from tqdm import tqdm

from lerobot_wm.constants import OBS_LATENT
from lerobot_wm.encode.episodes import embed_episodes, read_episodes
from lerobot_wm.files import appears_whole
from lerobot_wm.policies.common.names import OWN_NAMES, names_before
from lerobot_wm.policies.latent.policy import EncoderPolicy, encoder_config
from lerobot_wm.workers import check_same_settings

_EPISODES_PER_BATCH = 16


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
    world_model = policy.eval().world_model
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
        embeds, actions = embed_episodes(world_model, of_batch)
        if sample_seed is not None:
            # A seed for each batch: its samples do not depend on which job encodes it, or after what.
            [seed] = np.random.SeedSequence([sample_seed, batch.start]).generate_state(1)
            torch.manual_seed(int(seed))
        states = world_model.filter_embeds(embeds, actions, sample=sample_seed is not None)
        latents = states.latent.cpu()  # (B, T, L)
        yield torch.cat([latents[i, : len(episode)] for i, episode in enumerate(of_batch)])


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

"""Latents on their way to a dataset: a file per batch of episodes.

So several jobs can share the work, and a killed one goes on where it was.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from lerobot_wm.constants import OBS_LATENT
from lerobot_wm.encode.episodes import filter_batches
from lerobot_wm.policies.latent.policy import EncoderPolicy
from lerobot_wm.system import refuse_difference


@dataclass(frozen=True)
class LatentParts:
    """A folder of latents: `<first>-<last episode>.safetensors` is (N, L) for the frames of a batch.

    Attributes:
        folder: Where they lie.
        made_of: What they depend on; each file carries it, so that others never mix with them.
    """

    folder: Path
    made_of: dict[str, str]

    def missing(self, batches: Sequence[range]) -> list[range]:
        """Those of the batches that are not here yet.

        Raises:
            FileExistsError: The folder holds latents of anything else.
            ValueError: A file was not copied whole.
        """
        for path in sorted(self.folder.glob("*.safetensors")):
            self._check(path)
        return [batch for batch in batches if not self._path(batch).exists()]

    def complete(
        self,
        policy: EncoderPolicy,
        source: LeRobotDataset,
        batches: Sequence[range],
        rename_map: Mapping[str, str],
        sample_seed: int | None,
    ) -> None:
        """Encode those of the batches that are not here, see `filter_batches`; a file appears when it is whole.

        Raises:
            FileExistsError, ValueError: See `missing`.
            ValueError: Latents are not finite.
        """
        missing = self.missing(batches)
        if len(missing) < len(batches):
            print(f"{len(batches) - len(missing)} of {len(batches)} batches are in {self.folder} already.")
        if not missing:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        first_frames = source.meta.episodes["dataset_from_index"]
        with tqdm(total=sum(map(len, missing)), desc="Encoding", unit="episode") as bar:
            parts = filter_batches(policy, source, missing, rename_map=rename_map, sample_seed=sample_seed)
            for batch, latents in zip(missing, parts, strict=True):
                finite = latents.isfinite().all(dim=1)  # (N,)
                if not finite.all():
                    row = first_frames[batch.start] + int(finite.int().argmin())
                    raise ValueError(
                        f"The world model's latents are not finite from frame {row} of {source.repo_id} on: "
                        "its weights or the actions there are broken."
                    )
                partial = self._path(batch).with_suffix(".partial")
                save_file({OBS_LATENT: latents}, partial, metadata=self.made_of)
                partial.replace(self._path(batch))
                bar.update(len(batch))

    def read(self, batches: Sequence[range]) -> Tensor:
        """The latents of all these batches, (N, L) float32."""
        return torch.cat([load_file(self._path(batch))[OBS_LATENT] for batch in batches])

    def _path(self, batch: range) -> Path:
        return self.folder / f"{batch[0]:06d}-{batch[-1]:06d}.safetensors"

    def _check(self, path: Path) -> None:
        try:
            with safe_open(path, framework="pt") as file:
                found = file.metadata()
        except SafetensorError as error:
            raise ValueError(
                f"{path} is not whole: copy it again, or remove it and it is encoded."
            ) from error
        mend = f"repeat the flags they were made with, give another --output_root, or remove {self.folder}"
        refuse_difference(found, self.made_of, f"{path} holds latents", mend)

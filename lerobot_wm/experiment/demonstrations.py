"""The stages that make the data every arm learns from, and what it is judged on."""

from dataclasses import dataclass
from pathlib import Path

from lerobot_wm.constants import (
    DENSE_REWARD,
    NUM_SEEN_VARIATIONS,
    NUM_VARIATIONS,
    REPORTED_VARIATION_SET,
    SELECTION_VARIATION_SET,
)
from lerobot_wm.data.schema import COLLECTION_RECORD, RELABEL_RECORD
from lerobot_wm.experiment.commands import Dataset, lerobot_wm
from lerobot_wm.experiment.preset import Preset
from lerobot_wm.experiment.stage import Stage
from lerobot_wm.pipeline.share import shards_folder


@dataclass(frozen=True)
class Demonstrations:
    """Scripted demonstrations of the preset's tasks, in folders of `output_dir`."""

    preset: Preset
    output_dir: Path

    def sparse(self) -> Dataset:
        """On the seen variations, with the 0/1 reward."""
        count = self.preset.episodes_per_task
        return self._collect("dataset", count, NUM_SEEN_VARIATIONS, REPORTED_VARIATION_SET)

    def dense(self) -> Dataset:
        """The same with Meta-World's shaped reward."""
        source, folder = self.sparse(), self.output_dir / "dataset_dense"
        repo_id = f"local/{self.preset.name}_{folder.name}"
        flags = {
            **source.flags(),
            "reward": DENSE_REWARD,
            "output_repo_id": repo_id,
            "output_root": folder,
        }
        stage = Stage(
            name=folder.name,
            kind="relabel",
            argv=lerobot_wm("relabel", flags),
            folder=folder,
            artefact=folder / RELABEL_RECORD,
            needs=(source.made_by,),
        )
        return Dataset(stage, repo_id)

    def held_out(self) -> Dataset:
        """On positions that nothing is trained on, at most one episode on each."""
        count = min(NUM_VARIATIONS, self.preset.episodes_per_task)
        return self._collect("held_out", count, NUM_VARIATIONS, SELECTION_VARIATION_SET)

    def _collect(self, name: str, count: int, n_variations: int, variation_set: int) -> Dataset:
        folder, repo_id = self.output_dir / name, f"local/{self.preset.name}_{name}"
        flags = {
            "tasks": self.preset.tasks,
            "episodes_per_task": count,
            "variations": f"0-{n_variations - 1}",
            "variation_set": variation_set,
            "noise": self.preset.noise,
            "camera_name": self.preset.camera_name,
            "seed": 0,
            "repo_id": repo_id,
            "root": folder,
        }
        stage = Stage(
            name=name,
            kind="collect",
            argv=lerobot_wm("collect", flags),
            folder=folder,
            artefact=folder / COLLECTION_RECORD,
            checkpoint=shards_folder(folder),
            takes_workers=True,
        )
        return Dataset(stage, repo_id)

"""The experiment as stages: which command makes what, and from which other stage's result."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lerobot.common.train_utils import get_step_checkpoint_dir
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    OPTIMIZER_PARAM_GROUPS,
    PRETRAINED_MODEL_DIR,
    TRAINING_STATE_DIR,
)

from lerobot_wm.constants import (
    ENV_TYPE,
    NUM_VARIATIONS,
    QUALITY_NAME,
    RECORDS_NAME,
    REPORTED_VARIATION_SET,
    SELECTION_VARIATION_SET,
)
from lerobot_wm.data.latents import RECORD_PATH
from lerobot_wm.data.schema import COLLECTION_RECORD
from lerobot_wm.experiment.preset import Preset, config_file
from lerobot_wm.experiment.stage import Checkpoint, Dataset, Stage, lerobot_wm
from lerobot_wm.report.arms import WM_RSSM, Arm, Encoder
from lerobot_wm.train.resume import can_resume
from lerobot_wm.workers import parts_folder, shards_folder


@dataclass(frozen=True)
class Plan:
    """Builds the stages of an experiment.

    Args:
        preset: Its sizes.
        output_dir: Where everything is written.
        variation_set: The fixed variations that policies are rolled out on.
    """

    preset: Preset
    output_dir: Path
    variation_set: int

    def demonstrations(self) -> Dataset:
        """Scripted demonstrations, with the 0/1 reward."""
        count = self.preset.episodes_per_task
        return self._collect("dataset", count, self.preset.variations, REPORTED_VARIATION_SET)

    def held_out_demonstrations(self) -> Dataset:
        """Demonstrations of variations that nothing is trained on, at most one episode each."""
        count = min(NUM_VARIATIONS, self.preset.episodes_per_task)
        return self._collect("held_out", count, f"0-{NUM_VARIATIONS - 1}", SELECTION_VARIATION_SET)

    def _collect(self, name: str, count: int, variations: str, variation_set: int) -> Dataset:
        folder, repo_id = self.output_dir / name, f"local/{self.preset.name}_{name}"
        flags = {
            "tasks": self.preset.tasks,
            "episodes_per_task": count,
            "variations": variations,
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

    def evaluations(self, arm: Arm, seed: int) -> list[Stage]:
        """The last stages of an arm and seed. Each writes a records.jsonl into its folder."""
        if arm.training is None:
            return [self._expert(arm)]
        tasks = self.preset.task_names if arm.individual else [None]
        return [self._evaluation(arm, seed, task) for task in tasks]

    def policies(self, arm: Arm, seed: int) -> list[Stage]:
        """The training runs of an arm and seed."""
        if arm.training is None:
            return []
        tasks = self.preset.task_names if arm.individual else [None]
        return [self._policy(arm, seed, task).made_by for task in tasks]

    def world_model(self, seed: int) -> Checkpoint:
        """The world model of `wm_bc` and `wm_iql`."""
        return self._encoder(WM_RSSM, seed)

    def quality(self, seed: int) -> Stage:
        """The quality of this seed's world model on variations that it was not trained on."""
        world_model = self.world_model(seed)
        training, held_out = self.demonstrations(), self.held_out_demonstrations()
        name = f"seed_{seed}/quality"
        folder = self.output_dir / name
        flags = {"world_model_path": world_model.path, **held_out.flags(), **training.flags("train_dataset")}
        return Stage(
            name=name,
            kind="quality",
            argv=lerobot_wm("quality", {**flags, "output_dir": folder}),
            folder=folder,
            artefact=folder / QUALITY_NAME,
            needs=(world_model.made_by, training.made_by, held_out.made_by),
        )

    def _encoder(self, encoder: Encoder, seed: int) -> Checkpoint:
        source = self.demonstrations()
        if encoder.training is not None:
            return self._training(encoder.name, encoder.training, seed, source, *encoder.flags)
        name = f"seed_{seed}/{encoder.name}"
        folder = self.output_dir / name
        path = folder / PRETRAINED_MODEL_DIR
        stage = Stage(
            name=name,
            kind="init",
            argv=lerobot_wm("init", {**source.flags(), "seed": seed, "output_dir": folder}, *encoder.flags),
            folder=folder,
            artefact=path,
            needs=(source.made_by,),
        )
        return Checkpoint(stage, path)

    def _latents(self, encoder: Encoder, seed: int) -> Dataset:
        source, checkpoint = self.demonstrations(), self._encoder(encoder, seed)
        name = f"seed_{seed}/latents_{encoder.name}"
        folder, repo_id = self.output_dir / name, f"local/{self.preset.name}_{encoder.name}_{seed}"
        flags = {"world_model_path": checkpoint.path, **source.flags()}
        stage = Stage(
            name=name,
            kind="encode",
            argv=lerobot_wm("encode", {**flags, "output_repo_id": repo_id, "output_root": folder}),
            folder=folder,
            artefact=folder / RECORD_PATH,
            needs=(source.made_by, checkpoint.made_by),
            checkpoint=parts_folder(folder),
        )
        return Dataset(stage, repo_id)

    def _policy(self, arm: Arm, seed: int, task: str | None) -> Checkpoint:
        assert arm.training is not None
        run, flags, dataset = arm.run, list(arm.train_flags), self.demonstrations()
        needs: list[Stage] = []
        if arm.encoder is not None:
            encoder = self._encoder(arm.encoder, seed)
            flags.append(f"--policy.world_model_path={encoder.path}")
            if self.preset.trainings[arm.training]["policy"].get("finetune_world_model"):
                needs.append(encoder.made_by)
            else:
                dataset = self._latents(arm.encoder, seed)
        if task is not None:
            # A collection's episodes are in the order of its tasks, the same number for each.
            count, position = self.preset.episodes_per_task, self.preset.task_names.index(task)
            episodes = ",".join(map(str, range(position * count, (position + 1) * count)))
            run, flags = f"{run}_{task}", [*flags, f"--dataset.episodes=[{episodes}]"]
        return self._training(run, arm.training, seed, dataset, *flags, needs=needs)

    def _training(
        self, run: str, training: str, seed: int, dataset: Dataset, *more: str, needs: Sequence[Stage] = ()
    ) -> Checkpoint:
        name, config = f"seed_{seed}/{run}", config_file(self.output_dir, training)
        folder = self.output_dir / name
        steps = self.preset.trainings[training]["steps"]
        # Named by its step, not "last": only a complete training run is rolled out.
        final = get_step_checkpoint_dir(folder, steps, steps)
        last = folder / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME
        # A resumed run is given them again: the folders may have been moved.
        places = {"output_dir": folder, **dataset.flags()}
        stage = Stage(
            name=name,
            kind=training,
            argv=lerobot_wm("train", {"config_path": config, "seed": seed, "job_name": run, **places}, *more),
            folder=folder,
            artefact=final / TRAINING_STATE_DIR / OPTIMIZER_PARAM_GROUPS,
            needs=(dataset.made_by, *needs),
            checkpoint=last,
            can_resume=can_resume,
            resume_argv=lerobot_wm("train", {"config_path": last, "resume": "true", **places}),
        )
        return Checkpoint(stage, final / PRETRAINED_MODEL_DIR)

    def _evaluation(self, arm: Arm, seed: int, task: str | None) -> Stage:
        preset, policy = self.preset, self._policy(arm, seed, task)
        name = f"seed_{seed}/{self._prefix}_{arm.name}" + (f"_{task}" if task else "")
        folder = self.output_dir / name
        flags = {
            "policy.path": policy.path,
            "env.type": ENV_TYPE,
            "env.task": task or preset.tasks,
            "env.variation_set": self.variation_set,
            "env.camera_name": preset.camera_name,
            "env.episode_length": preset.episode_length,
            "eval.n_episodes": preset.rollouts_per_task,
            "seed": preset.first_eval_seed,
            "videos_per_task": preset.videos_per_task,
            "output_dir": folder,
            "arm": arm.name,
            "preset": preset.name,
        }
        return Stage(
            name=name,
            kind="evaluate_task" if task else "evaluate",
            argv=lerobot_wm("eval", flags, *arm.eval_flags),
            folder=folder,
            artefact=folder / RECORDS_NAME,
            needs=(policy.made_by,),
            takes_workers=True,
        )

    def _expert(self, arm: Arm) -> Stage:
        name = f"{self._prefix}_{arm.name}"
        folder = self.output_dir / name
        flags = {
            "tasks": self.preset.tasks,
            "variation_set": self.variation_set,
            "variations": ",".join(map(str, self.preset.rollout_variations)),
            "episode_length": self.preset.episode_length,
            "output_dir": folder,
            "preset": self.preset.name,
        }
        return Stage(
            name=name,
            kind="expert",
            argv=lerobot_wm("expert", flags),
            folder=folder,
            artefact=folder / RECORDS_NAME,
            takes_workers=True,
        )

    @property
    def suffix(self) -> str:
        """What follows the names of results on another variation set than the preset's."""
        return "" if self.variation_set == self.preset.variation_set else f"_set{self.variation_set}"

    @property
    def _prefix(self) -> str:
        return f"eval{self.suffix}"

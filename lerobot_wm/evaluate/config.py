"""The flags of `lerobot-wm eval`: lerobot-eval's and those of the records."""

from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs.default import EvalConfig, WandBConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.envs.configs import EnvConfig

from lerobot_wm.constants import RECORDS_NAME
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.envs.variations import is_seen, split_variations
from lerobot_wm.policies.common.checks import check_fit
from lerobot_wm.policies.latent.config import LatentPolicyConfig


@dataclass
class BatchedEvalConfig(EvalConfig):
    """LeRobot's `--eval.*` flags, with defaults for cheap environments.

    One batch of environments in the policy's own process: a worker process per environment costs more (each
    imports torch) than it gains where a step with its image takes a few milliseconds.
    """

    batch_size: int = 25
    use_async_envs: bool = False


@dataclass
class EvaluateConfig(EvalPipelineConfig):
    """LeRobot's evaluation flags and those of the records."""

    eval: BatchedEvalConfig = field(default_factory=BatchedEvalConfig)
    # Records file to write; <output_dir>/records.jsonl when not given.
    records: Path | None = None
    # Name of the method in tables; the policy type when not given.
    arm: str | None = None
    # Name of the settings the policy was trained with.
    preset: str = "custom"
    # Processes; each takes whole tasks.
    num_workers: int = 1
    # How many rollouts of each task, the first ones, are kept as videos.
    videos_per_task: int = 1
    # `--wandb.enable=true` logs the tables to the run that trained the policy.
    wandb: WandBConfig = field(default_factory=WandBConfig)

    def validate(self) -> None:
        """Refuse what cannot run, before anything is loaded.

        Raises:
            ValueError: no policy, no seed, a rollout that would run twice, a flag that belongs elsewhere, or an
                environment that the policy was not trained for.
        """
        if self.policy is None:
            raise ValueError("No policy: give --policy.path=CHECKPOINT_FOLDER_OR_HUB_ID.")
        if self.seed is None:
            raise ValueError(
                "--seed=null: each rollout needs its seed. Give the first one, such as --seed=0."
            )
        if self.num_workers < 1:
            raise ValueError(f"--num_workers={self.num_workers}: expected at least 1.")
        if self.eval.recording:
            raise ValueError("--eval.recording=true records datasets: use `lerobot-eval` for that.")
        if isinstance(self.policy, LatentPolicyConfig) and self.policy.save_predicted_video:
            raise ValueError(
                "--policy.save_predicted_video=true films predictions: use `lerobot-eval` for that."
            )
        n_variations = len({variation_of(self.env, seed) for seed in self.seeds})
        if n_variations < self.eval.n_episodes:
            raise ValueError(
                f"--eval.n_episodes={self.eval.n_episodes}, but there are only {n_variations} variations: "
                f"use --eval.n_episodes={n_variations}."
            )
        if self.policy.pretrained_path is None:
            raise ValueError(
                f"--policy.type={self.policy.type} alone would be untrained: give --policy.path=CHECKPOINT."
            )
        check_fit(self.policy, self.env, self.rename_map)

    @property
    def records_file(self) -> Path:
        """The records file to write."""
        return self.records or Path(self.output_dir) / RECORDS_NAME

    @property
    def arm_name(self) -> str:
        """The name of the method in records."""
        return self.arm or self.policy.type

    @property
    def seeds(self) -> range:
        """The seeds of the rollouts of each task."""
        return range(self.seed, self.seed + self.eval.n_episodes)


def variation_of(env: EnvConfig, seed: int) -> tuple[int, bool | None]:
    """What a record says of `reset(seed=seed)`: (variation, seen); for other environments (seed, None)."""
    if not isinstance(env, MetaworldMTEnvConfig):
        return seed, None
    variations = split_variations(env.split, env.variation_set)
    variation = variations[seed % len(variations)]
    return variation, is_seen(variation, env.variation_set)

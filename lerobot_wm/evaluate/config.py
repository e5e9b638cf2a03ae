"""The flags of `lerobot-wm eval`: those of `lerobot-eval`, and of the records."""

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
    """LeRobot's `--eval.*` flags, with defaults for fast environments.

    Environments run in the policy's own process: where a step takes a few milliseconds, a process for each environment
    costs more than it gains, because each imports torch.
    """

    batch_size: int = 25
    use_async_envs: bool = False


@dataclass
class EvaluateConfig(EvalPipelineConfig):
    """LeRobot's evaluation flags, and those of the records."""

    eval: BatchedEvalConfig = field(default_factory=BatchedEvalConfig)
    # Name of the method in tables; the policy type when not given.
    arm: str | None = None
    # Name of the settings the policy was trained with.
    preset: str = "custom"
    # Processes; each takes whole tasks.
    num_workers: int = 1
    # How many rollouts of each task are saved as videos, from the first one on.
    videos_per_task: int = 1
    # `--wandb.enable=true` logs tables to the run that trained the policy.
    wandb: WandBConfig = field(default_factory=WandBConfig)

    def validate(self) -> None:
        """Check the flags before anything is loaded.

        Raises:
            ValueError: There is no trained policy, a rollout would run twice, a flag has no effect here, or the policy
                was not trained for the environment.
        """
        if self.policy is None or self.policy.pretrained_path is None:
            raise ValueError("No trained policy: give --policy.path=CHECKPOINT_FOLDER_OR_HUB_ID.")
        films_predictions = isinstance(self.policy, LatentPolicyConfig) and self.policy.save_predicted_video
        if self.eval.recording or films_predictions:
            raise ValueError(
                "--eval.recording and --policy.save_predicted_video have no effect here: use `lerobot-eval`."
            )
        n_variations = len({variation_of(self.env, seed) for seed in self.seeds})
        if n_variations < self.eval.n_episodes:
            raise ValueError(
                f"--eval.n_episodes={self.eval.n_episodes}, but there are only {n_variations} variations: "
                f"use --eval.n_episodes={n_variations}."
            )
        check_fit(self.policy, self.env, self.rename_map)

    @property
    def records_file(self) -> Path:
        """The records file to write."""
        return Path(self.output_dir) / RECORDS_NAME

    @property
    def arm_name(self) -> str:
        """The method's name in records."""
        return self.arm or self.policy.type

    @property
    def seeds(self) -> range:
        """The seeds of the rollouts of each task."""
        return range(self.seed, self.seed + self.eval.n_episodes)


def variation_of(env: EnvConfig, seed: int) -> tuple[int, bool | None]:
    """(variation, seen) of `reset(seed=seed)`, for records; (seed, None) for other environments than metaworld_mt."""
    if not isinstance(env, MetaworldMTEnvConfig):
        return seed, None
    variations = split_variations(env.split, env.variation_set)
    variation = variations[seed % len(variations)]
    return variation, is_seen(variation, env.variation_set)

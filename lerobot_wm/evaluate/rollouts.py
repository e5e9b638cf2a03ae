"""The flags of `lerobot-wm eval`, and LeRobot's own `rollout`, arranged so that each seed of each task runs once."""

from contextlib import nullcontext
from dataclasses import dataclass, field
from itertools import batched
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from lerobot.configs.default import EvalConfig, WandBConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from lerobot.envs.configs import EnvConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.device_utils import get_safe_torch_device
from lerobot.utils.io_utils import write_video
from lerobot.utils.random_utils import set_seed

from lerobot_wm.constants import NUM_VARIATIONS, RECORDS_NAME
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.envs.variations import is_seen
from lerobot_wm.evaluate.wandb_log import training_config
from lerobot_wm.policies.common.checks import check_fit
from lerobot_wm.policies.latent.config import LatentPolicyConfig
from lerobot_wm.records import Record

# Frames of videos are enlarged by a whole factor up to this height in pixels.
VIDEO_SIZE = 256


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
    variation = seed % NUM_VARIATIONS
    return variation, is_seen(variation, env.variation_set)


class TaskRunner:
    """A loaded policy and its environments, which rolls out one task after another."""

    def __init__(self, cfg: EvaluateConfig) -> None:
        self.cfg = cfg
        self.device = get_safe_torch_device(cfg.policy.device)
        trained = training_config(cfg.policy.pretrained_path, cfg.policy.pretrained_revision)
        self.training_seed = trained.get("seed")
        # One vector environment per batch size, so that a shorter last batch runs no other seeds.
        sizes = {len(seeds) for seeds in self._batches()}
        self.envs = {size: make_task_envs(cfg, size) for size in sizes}
        self.policy = make_policy(cfg=cfg.policy, env_cfg=cfg.env, rename_map=cfg.rename_map).eval()
        preprocessor, postprocessor = make_pre_post_processors(
            policy_cfg=cfg.policy,
            pretrained_path=cfg.policy.pretrained_path,
            pretrained_revision=cfg.policy.pretrained_revision,
            preprocessor_overrides={
                "device_processor": {"device": str(self.policy.config.device)},
                "rename_observations_processor": {"rename_map": cfg.rename_map},
            },
        )
        env_preprocessor, env_postprocessor = make_env_pre_post_processors(cfg.env, cfg.policy)
        self.processors = {
            "preprocessor": preprocessor,
            "postprocessor": postprocessor,
            "env_preprocessor": env_preprocessor,
            "env_postprocessor": env_postprocessor,
        }

    def run(self, task: str) -> list[Record]:
        """Roll out every seed of one task once."""
        # A rollout may now end differently than in an earlier evaluation, and its video would have another name.
        for video in self._videos(task).glob("variation_*_*.mp4"):
            video.unlink()
        # For each task, so that rollouts do not depend on how tasks are spread over processes.
        set_seed(self.cfg.seed)
        records: list[Record] = []
        for seeds in self._batches():
            records += self._run_batch(self.envs[len(seeds)][task], task, list(seeds))
        for envs in self.envs.values():
            envs[task].close()
        return records

    def _batches(self) -> list[tuple[int, ...]]:
        return list(batched(self.cfg.seeds, self.cfg.eval.batch_size))

    def _run_batch(self, env: gym.vector.VectorEnv, task: str, seeds: list[int]) -> list[Record]:
        filmed = [i for i, seed in enumerate(seeds) if seed < self.cfg.seed + self.cfg.videos_per_task]
        frames: list[list[np.ndarray]] = []  # [step][filmed sub-environment]
        use_amp = self.cfg.policy.use_amp
        with torch.autocast(self.device.type) if use_amp else nullcontext():
            data = rollout(
                env,
                self.policy,
                **self.processors,
                seeds=seeds,
                render_callback=(lambda env: frames.append(_render(env, filmed))) if filmed else None,
            )
        records = [self._record(task, seed, data, i) for i, seed in enumerate(seeds)]
        # Otherwise the environment is reset before it is rendered: the last frame is the start of another episode.
        shows_the_end = env.metadata.get("autoreset_mode") is not AutoresetMode.SAME_STEP
        for column, i in enumerate(filmed):
            clip = [step[column] for step in frames[: records[i]["steps"] + shows_the_end]]
            result = "success" if records[i]["success"] else "failure"
            folder = self._videos(task)
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"variation_{records[i]['variation']:02d}_{result}.mp4"
            write_video(path, [_enlarged(frame) for frame in clip], env.metadata["render_fps"])
        return records

    def _videos(self, task: str) -> Path:
        return self.cfg.output_dir / "videos" / task

    def _record(self, task: str, seed: int, data: dict[str, torch.Tensor], i: int) -> Record:
        steps = int(data["done"][i].int().argmax()) + 1  # argmax: the first True
        variation, seen = variation_of(self.cfg.env, seed)
        return {
            "arm": self.cfg.arm_name,
            "policy_type": self.cfg.policy.type,
            "preset": self.cfg.preset,
            "seed": self.training_seed,
            "task": task,
            "variation": variation,
            "seen": seen,
            "success": bool(data["success"][i, :steps].any()),
            "steps": steps,
            "return": float(data["reward"][i, :steps].sum()),
            "variation_set": getattr(self.cfg.env, "variation_set", None),
        }


def task_names(cfg: EvaluateConfig) -> list[str]:
    """Names of the environment's tasks, as in records."""
    envs = make_task_envs(cfg, n_envs=1)
    close_envs(envs)
    return list(envs)


def make_task_envs(cfg: EvaluateConfig, n_envs: int) -> dict[str, gym.vector.VectorEnv]:
    """Make a vector environment with `n_envs` sub-environments for each task.

    LeRobot returns {group: {task id: vector environment}}; the groups of metaworld_mt are its tasks.
    """
    groups = make_env(cfg.env, n_envs, cfg.eval.use_async_envs, trust_remote_code=cfg.trust_remote_code)
    return {
        group if len(by_id) == 1 else f"{group}_{task_id}": env
        for group, by_id in groups.items()
        for task_id, env in by_id.items()
    }


def _render(env: gym.vector.VectorEnv, indices: list[int]) -> list[np.ndarray]:
    """Current images (H, W, 3) of some sub-environments."""
    if isinstance(env, gym.vector.SyncVectorEnv):
        return [np.asarray(env.envs[i].render()) for i in indices]
    images = env.call("render")  # type: ignore[attr-defined]
    return [images[i] for i in indices]


def _enlarged(image: np.ndarray) -> np.ndarray:
    """(H, W, 3) -> (fH, fW, 3) with a whole factor f, because players blur small videos."""
    factor = max(1, VIDEO_SIZE // image.shape[0])
    return image.repeat(factor, axis=0).repeat(factor, axis=1)

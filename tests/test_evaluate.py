"""`lerobot-wm eval` with a real LeRobot policy, on a toy environment and on Meta-World."""

import json
import sys
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import av
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from huggingface_hub.errors import LocalEntryNotFoundError
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.policies import make_pre_post_processors
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.scripts.lerobot_eval import eval_policy

from lerobot_wm import cli
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.evaluate import rollouts
from lerobot_wm.evaluate.command import evaluate
from lerobot_wm.evaluate.rollouts import BatchedEvalConfig, EvaluateConfig, TaskRunner, variation_of
from lerobot_wm.evaluate.wandb_log import training_config
from lerobot_wm.policies.common import checkpoint
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.records import Record, read_records

IMAGE = PolicyFeature(FeatureType.VISUAL, (64, 64, 3))
VECTOR = PolicyFeature(FeatureType.STATE, (4,))
ACTION = PolicyFeature(FeatureType.ACTION, (4,))


class WalkEnv(gym.Env):
    """The position is the sum of the actions; succeeds beyond a distance that depends on the seed."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gym.spaces.Dict(
        {
            "pixels": gym.spaces.Box(0, 255, (64, 64, 3), np.uint8),
            "agent_pos": gym.spaces.Box(-np.inf, np.inf, (4,), np.float32),
        }
    )
    action_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    _max_episode_steps = 8

    def __init__(self, task: str, unit: float) -> None:
        self.task = self.task_description = task
        self.unit = unit

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-1, 1, 4).astype(np.float32)
        self.start = self.position.copy()
        self.distance = self.unit * self.np_random.uniform(1, 10)
        self.steps = 0
        return self._observation(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple:
        self.position = self.position + action.astype(np.float32)
        self.steps += 1
        success = bool(np.linalg.norm(self.position - self.start) > self.distance)
        return self._observation(), 0.5 + success, success, self.steps >= 8, {"is_success": success}

    def render(self) -> np.ndarray:
        return np.full((64, 64, 3), 20 * self.steps, np.uint8)

    def _observation(self) -> dict[str, np.ndarray]:
        return {"pixels": self.render(), "agent_pos": self.position}


@EnvConfig.register_subclass("walk_for_tests")
@dataclass
class WalkEnvConfig(EnvConfig):
    task: str = "near,far"
    fps: int = 10
    features: dict = field(default_factory=lambda: {"pixels": IMAGE, "agent_pos": VECTOR, "action": ACTION})
    features_map: dict = field(
        default_factory=lambda: {
            "pixels": "observation.image",
            "agent_pos": "observation.state",
            "action": "action",
        }
    )

    @property
    def gym_kwargs(self) -> dict:
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict:
        def vector(task: str, unit: float) -> gym.vector.VectorEnv:
            make = freeze_after_episode_end(lambda: WalkEnv(task, unit))
            return gym.vector.SyncVectorEnv([make] * n_envs)

        return {"near": {0: vector("near", 0.05)}, "far": {0: vector("far", 0.6)}}


@pytest.fixture(scope="module")
def policy_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small untrained ACT checkpoint, said to be trained with seed 7."""
    torch.manual_seed(0)
    config = ACTConfig(
        input_features={
            "observation.image": PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
            "observation.state": VECTOR,
        },
        output_features={"action": ACTION},
        chunk_size=4,
        n_action_steps=2,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_decoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=8,
        pretrained_backbone_weights=None,
        normalization_mapping={},
        device="cpu",
        push_to_hub=False,
    )
    path = tmp_path_factory.mktemp("act")
    ACTPolicy(config).save_pretrained(path)
    for processor in make_pre_post_processors(config, dataset_stats={}):
        processor.save_pretrained(path)
    (path / "train_config.json").write_text(json.dumps({"seed": 7}))
    return path


def config_for(
    policy_path: Path, output_dir: Path, env: EnvConfig, n_episodes: int, batch_size: int, **flags: object
) -> EvaluateConfig:
    policy = PreTrainedConfig.from_pretrained(policy_path)
    policy.pretrained_path = policy_path
    sizes = BatchedEvalConfig(n_episodes=n_episodes, batch_size=batch_size)
    return EvaluateConfig(env=env, policy=policy, output_dir=output_dir, eval=sizes, seed=0, **flags)


def test_each_seed_runs_once_whatever_the_batch_size(policy_path: Path, tmp_path: Path) -> None:
    one_by_one = evaluate(config_for(policy_path, tmp_path / "one", WalkEnvConfig(), 7, 1))
    assert [(r["task"], r["variation"]) for r in one_by_one] == [
        (task, seed) for task in ("near", "far") for seed in range(7)
    ]
    assert len({(r["success"], r["steps"]) for r in one_by_one}) > 2, "rollouts must differ to be compared"
    by_threes = evaluate(config_for(policy_path, tmp_path / "three", WalkEnvConfig(), 7, 3))
    assert [r | {"return": None} for r in by_threes] == [r | {"return": None} for r in one_by_one]
    np.testing.assert_allclose([r["return"] for r in by_threes], [r["return"] for r in one_by_one], rtol=1e-5)


def test_two_processes_give_the_same_records_and_videos(policy_path: Path, tmp_path: Path) -> None:
    env = MetaworldMTEnvConfig(task="window-close-v3,reach-v3", episode_length=10)
    for workers in (1, 2):
        folder = tmp_path / str(workers)
        evaluate(config_for(policy_path, folder, env, 2, 2, num_workers=workers, videos_per_task=2))
    assert len(read_records([tmp_path / "2" / "records.jsonl"])) == 4
    videos = (tmp_path / "1").rglob("*.mp4")
    files = [Path("records.jsonl"), *(video.relative_to(tmp_path / "1") for video in videos)]
    assert len(files) == 5
    for file in files:
        assert (tmp_path / "2" / file).read_bytes() == (tmp_path / "1" / file).read_bytes()


def test_records_agree_with_lerobot_eval(policy_path: Path, tmp_path: Path) -> None:
    cfg = config_for(policy_path, tmp_path, WalkEnvConfig(), 6, 2)
    records = [record for record in evaluate(cfg) if record["task"] == "near"]
    runner = TaskRunner(cfg)
    theirs = eval_policy(
        runner.envs[2]["near"], runner.policy, **runner.processors, n_episodes=6, start_seed=0
    )["per_episode"]
    assert [r["success"] for r in records] == [e["success"] for e in theirs]
    np.testing.assert_allclose([r["return"] for r in records], [e["sum_reward"] for e in theirs], rtol=1e-5)


def test_videos_end_with_the_episode_where_the_next_begins_at_once(
    policy_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in PushT and ALOHA, which LeRobot has reset within the last step."""

    def create(self: WalkEnvConfig, n_envs: int, use_async_envs: bool = False) -> dict:
        make = partial(WalkEnv, "far", 0.6)
        return {"far": {0: gym.vector.SyncVectorEnv([make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)}}

    monkeypatch.setattr(WalkEnvConfig, "create_envs", create)
    cfg = config_for(policy_path, tmp_path, WalkEnvConfig(), 1, 1, videos_per_task=1)
    [record] = evaluate(cfg)
    [video] = (tmp_path / "videos").rglob("*.mp4")
    with av.open(video) as container:
        frames = [frame.to_ndarray(format="rgb24").mean() for frame in container.decode(video=0)]
    assert frames == pytest.approx([20 * t for t in range(record["steps"])], abs=4)


def test_records_of_any_environment(policy_path: Path, tmp_path: Path) -> None:
    cfg = config_for(policy_path, tmp_path, WalkEnvConfig(), 3, 3, arm="mine", preset="tiny")
    records = evaluate(cfg)
    assert records == read_records([tmp_path / "records.jsonl"])
    for record in records:
        assert record.keys() == Record.__annotations__.keys()
        assert (record["arm"], record["policy_type"], record["preset"]) == ("mine", "act", "tiny")
        assert record["seed"] == 7, "the training seed, from train_config.json"
        assert record["seen"] is None
        assert record["return"] == pytest.approx(0.5 * record["steps"] + record["success"])
    assert not list(tmp_path.glob("*.part"))


def test_metaworld_from_the_command_line(
    policy_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    flags = (
        f"--policy.path={policy_path} --env.type=metaworld_mt --env.task=reach-v3,window-close-v3 "
        f"--env.episode_length=12 --eval.n_episodes=4 --eval.batch_size=3 --seed=8 --videos_per_task=2 "
        f"--output_dir={tmp_path}"
    )
    monkeypatch.setattr(sys, "argv", ["lerobot-wm", "eval", *flags.split()])
    cli.main()

    records = read_records([tmp_path / "records.jsonl"])
    reach = [record for record in records if record["task"] == "reach-v3"]
    assert [(r["variation"], r["seen"]) for r in reach] == [(8, True), (9, True), (10, False), (11, False)]
    assert len(records) == 8
    assert {record["steps"] for record in records} == {12}

    info = json.loads((tmp_path / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 8
    assert info["seen"]["n_episodes"] == info["per_task"]["reach-v3"]["n_episodes"] == 4
    assert info["overall"]["pc_success_ci95"][1] == pytest.approx(32.4, abs=0.1)  # Wilson, 0 of 8
    assert "reach-v3" in capsys.readouterr().out

    videos = sorted(path.relative_to(tmp_path / "videos") for path in tmp_path.glob("videos/*/*.mp4"))
    assert [str(path) for path in videos][:2] == [
        "reach-v3/variation_08_failure.mp4",
        "reach-v3/variation_09_failure.mp4",
    ]
    with av.open(str(tmp_path / "videos" / videos[0])) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 13  # the first observation and one after each step
    assert frames[0].shape == (256, 256, 3)


@pytest.mark.parametrize(("seed", "expected"), [(57, (7, True)), (49, (49, False))])
def test_variation_of_a_seed_is_the_environments(seed: int, expected: tuple[int, bool]) -> None:
    config = MetaworldMTEnvConfig(task="reach-v3")
    assert variation_of(config, seed) == expected
    env = config.create_envs(n_envs=1)["reach-v3"][0]
    assert env.reset(seed=[seed])[1]["variation"] == [expected[0]]
    env.close()


def test_no_variation_of_the_second_set_is_seen() -> None:
    config = MetaworldMTEnvConfig(task="reach-v3", variation_set=43)
    assert variation_of(config, 3) == (3, False)


def test_earlier_records_are_never_overwritten(policy_path: Path, tmp_path: Path) -> None:
    (tmp_path / "records.jsonl").write_text("")
    with pytest.raises(FileExistsError, match=r"records\.jsonl"):
        evaluate(config_for(policy_path, tmp_path, WalkEnvConfig(), 2, 2))


def test_videos_of_an_earlier_evaluation_are_removed(policy_path: Path, tmp_path: Path) -> None:
    # A rollout that fails now would be shown beside its earlier success.
    folder = tmp_path / "videos" / "near"
    folder.mkdir(parents=True)
    for name in ("variation_00_success", "variation_00_failure", "variation_05_failure", "own"):
        (folder / f"{name}.mp4").write_text("")
    records = evaluate(config_for(policy_path, tmp_path, WalkEnvConfig(), 2, 1, videos_per_task=2))
    written = {
        f"variation_{r['variation']:02d}_{'success' if r['success'] else 'failure'}.mp4"
        for r in records
        if r["task"] == "near"
    }
    assert {path.name for path in folder.iterdir()} == {*written, "own.mp4"}


def test_repeated_variations_are_refused(policy_path: Path, tmp_path: Path) -> None:
    cfg = config_for(policy_path, tmp_path, MetaworldMTEnvConfig(task="reach-v3"), 51, 4)
    with pytest.raises(ValueError, match=r"use --eval\.n_episodes=50"):
        evaluate(cfg)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policy": None}, r"--policy\.path"),
        ({"policy": WMBCConfig()}, r"--policy\.path"),
        ({"eval": BatchedEvalConfig(n_episodes=1, recording=True)}, "lerobot-eval"),
        ({"policy": WMBCConfig(save_predicted_video=True, pretrained_path=Path("x"))}, "lerobot-eval"),
    ],
)
def test_bad_flags_are_refused(policy_path: Path, tmp_path: Path, change: dict, message: str) -> None:
    cfg = config_for(policy_path, tmp_path, WalkEnvConfig(), 1, 1)
    for name, value in change.items():
        setattr(cfg, name, value)
    with pytest.raises(ValueError, match=message):
        evaluate(cfg)


def test_processors_and_seed_are_of_the_policys_revision(
    policy_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that were checked before."""
    asked = []
    make = rollouts.make_pre_post_processors

    def noting(*args: object, pretrained_revision: str | None = None, **kwargs: object) -> tuple:
        asked.append(pretrained_revision)
        return make(*args, **kwargs)

    monkeypatch.setattr(rollouts, "make_pre_post_processors", noting)
    monkeypatch.setattr(rollouts, "training_config", lambda path, revision: asked.append(revision) or {})
    cfg = config_for(policy_path, tmp_path, WalkEnvConfig(), 1, 1)
    cfg.policy.pretrained_revision = "v1"
    TaskRunner(cfg)
    assert asked == ["v1", "v1"]


def test_a_hub_that_cannot_be_reached_is_no_broken_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    def offline(*args: object, **kwargs: object) -> str:
        raise LocalEntryNotFoundError("not in the cache")

    monkeypatch.setattr(checkpoint, "hf_hub_download", offline)
    with pytest.raises(LocalEntryNotFoundError):
        checkpoint.read_config("user/policy")
    assert training_config(Path("user/policy")) == {}, "the rest of it is here"


def test_a_checkpoint_without_training_configuration(tmp_path: Path) -> None:
    assert training_config(tmp_path) == {}

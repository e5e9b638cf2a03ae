"""Records, evaluations and a small dataset for the report."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.constants import ACTION, FPS, OBS_IMAGE, OBS_STATE
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
from lerobot_wm.inspect.open_loop import WINDOW
from lerobot_wm.inspect.quality import QualityConfig, quality
from lerobot_wm.inspect.replay import REPLAY_NAME
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.records import Record, record_line
from lerobot_wm.world_model.config import RSSMConfig
from tests.flags import DATASET_FLAGS

TASKS = ("reach-v3", "window-close-v3")


@pytest.fixture
def make_records() -> Callable[..., list[Record]]:
    """Records of one run: for each task the number of successes on 10 seen and 40 unseen variations."""

    def make(arm: str, successes: dict[str, tuple[int, int]], seed: int | None = 0) -> list[Record]:
        return [
            {
                "arm": arm,
                "policy_type": "wm_bc",
                "preset": "test",
                "seed": seed,
                "task": task,
                "variation": k,
                "seen": k < 10,
                "success": k < seen or 10 <= k < 10 + unseen,
                "steps": 60 + k,
                "return": float(k < seen),
            }
            for task, (seen, unseen) in successes.items()
            for k in range(50)
        ]

    return make


@pytest.fixture
def records_file(tmp_path: Path, make_records: Callable[..., list[Record]]) -> Path:
    """Two runs of 50 rollouts on each of two tasks."""
    records = make_records("wm_bc", {"reach-v3": (4, 15), "window-close-v3": (10, 40)})
    records += make_records("wm_iql", {"reach-v3": (5, 10), "window-close-v3": (9, 38)})
    path = tmp_path / "records.jsonl"
    path.write_text("".join(map(record_line, records)))
    return path


@pytest.fixture(scope="session")
def episodes_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LeRobotDataset of random actions on Meta-World: per task one episode long enough, and one too short."""
    root = tmp_path_factory.mktemp("episodes") / "dataset"
    features = {
        OBS_IMAGE: {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
        OBS_STATE: {"dtype": "float32", "shape": (4,), "names": None},
        ACTION: {"dtype": "float32", "shape": (4,), "names": None},
    }
    dataset = LeRobotDataset.create("test/episodes", FPS, features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for task in TASKS:
        env = MetaworldMTEnv(task)
        for length in (WINDOW + 2, 6):
            observation, _ = env.reset(seed=0)
            for _ in range(length):
                action = rng.uniform(-1, 1, 4).astype(np.float32)
                frame = {
                    OBS_IMAGE: observation["pixels"],
                    OBS_STATE: observation["agent_pos"],
                    ACTION: action,
                }
                dataset.add_frame(frame | {"task": env.task_description})
                observation = env.step(action)[0]
            dataset.save_episode()
        env.close()
    dataset.finalize()
    return root


@pytest.fixture(scope="session")
def untrained_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained wm_rssm checkpoint with small latents."""
    torch.manual_seed(0)
    features = {
        "input_features": {
            OBS_IMAGE: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
            OBS_STATE: PolicyFeature(FeatureType.STATE, (4,)),
        },
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (4,))},
    }
    rssm = RSSMConfig(deter_dim=16, stoch_dim=8, hidden_dim=16, reward_hidden_dim=16)
    policy = WMRSSMPolicy(WMRSSMConfig(rssm=rssm, device="cpu", push_to_hub=False, **features))
    path = tmp_path_factory.mktemp("wm_rssm")
    policy.save_pretrained(path)
    return path


@pytest.fixture(scope="session")
def quality_path(demos_root: Path, untrained_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The quality.json of the untrained world model on the demonstrations, probed by cross-validation."""
    dataset = SourceConfig("test/demos", str(demos_root))
    folder = tmp_path_factory.mktemp("quality")
    return quality(QualityConfig(str(untrained_path), dataset, folder, episodes_per_task=3))


@pytest.fixture(scope="session")
def replay_path(
    demos_root: Path,
    policy_paths: dict[str, Path],
    tmp_path_factory: pytest.TempPathFactory,
    lerobot_wm_command: Callable[..., None],
) -> Path:
    """The replay.json of a policy on one of its training episodes."""
    folder = tmp_path_factory.mktemp("replay")
    lerobot_wm_command(
        f"replay --policy.path={policy_paths['wm_bc']} --episodes=[1] --output_dir={folder}",
        DATASET_FLAGS.format(root=demos_root),
    )
    return folder / REPLAY_NAME

"""The commands and the program of docs/your_data.md, in their order, at a size for tests."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_train

from lerobot_wm.inspect.replay import HOLD, REPEAT
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from tests.documents import blocks, commands, commands_of, with_flags
from tests.extended.arm import JOINTS, run_rollout
from tests.flags import SMALL_WORLD_MODEL
from tests.recording import FRONT, WRIST, camera, record, vector

DOCUMENT = "docs/your_data.md"
FEATURES = {
    FRONT: camera(96, 128),
    WRIST: camera(48, 48),
    "observation.state": vector(9),
    "action": vector(7),
    "next.success": vector(1, "bool"),
}
SECTIONS = ["data", "replay", "imagination", "knowledge", "training", "provenance"]
CAMERAS = {"front": [48, 64], "wrist": [32, 32]}


def small(words: list[str]) -> list[str]:
    """The command with a few steps, a few samples and a small world model."""
    if words[:2] == ["lerobot-wm", "encode"]:
        return [*words, "--device=cpu"]
    if words[1] in ("rename", "repair"):
        return words
    sizes = "--steps=2 --batch_size=2 --policy.device=cpu --num_workers=0"
    if "--policy.type=wm_rssm" in words:
        sizes += f" {SMALL_WORLD_MODEL} --policy.window_length=6"
    kept = [word for word in words if not word.startswith(("--steps", "--batch_size"))]
    return [*kept, *sizes.split()]


def record_robot(root: Path) -> None:
    """Two cameras, and absolute targets near the measured joints at 30 Hz; no reward."""
    joints = {"dtype": "float32", "shape": (len(JOINTS),), "names": list(JOINTS)}
    features = {f"observation.images.{name}": camera(*size, "video") for name, size in CAMERAS.items()}

    def reach(t: int, length: int) -> dict[str, np.ndarray]:
        # The episode's length sets how far each joint goes; the arm follows its targets two frames later.
        goal = np.sin(length * np.arange(1, len(JOINTS) + 1))
        state, action = (goal * (1 - np.cos(np.pi * min(u / length, 1))) for u in (t, t + 2))
        return {"observation.state": state.astype(np.float32), "action": action.astype(np.float32)}

    features |= {"observation.state": joints, "action": joints}
    record(root, features, [("Pick up the cup", length) for length in (56, 60, 64, 52)], reach, fps=30)


def test_from_recordings_to_the_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lerobot_wm_command: Callable[..., None]
) -> None:
    """The first list of commands: the episode of each command was held out, and the arm moves."""
    record_robot(tmp_path / "data" / "robot")
    monkeypatch.chdir(tmp_path)
    *looks, rollout = commands_of(blocks(DOCUMENT, "bash")[0])
    for words in looks:
        if words[1] == "train":
            words = with_flags(small(words), eval_steps=1)
        elif words[1] == "dream":
            words = with_flags(words, episode=3)
        lerobot_wm_command(*words[1:])
    made = WMBCConfig.from_pretrained("outputs/bc/checkpoints/last/pretrained_model")
    assert made.relative_indices == [0, 1, 2]
    assert made.world_model.rssm.hidden_action_share == 0.5
    found = json.loads(Path("outputs/replay/replay.json").read_text())
    assert found["n_episodes"] == {"held out": 1}
    assert {label.split(",")[0] for label in found["error_in_std"]} >= {"bc", "blind", HOLD, REPEAT}
    assert Path("outputs/dream/episode_3.mp4").is_file()
    page = Path("outputs/report/index.html").read_text()
    assert [name for name in SECTIONS if f'<section id="{name}">' in page] == SECTIONS
    assert "Episode 3" in page
    arm = run_rollout(with_flags(rollout, duration=0.1), tmp_path, CAMERAS)
    assert all(arm.joints.values())


@pytest.mark.slow
def test_the_page_works_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lerobot_wm_command: Callable[..., None]
) -> None:
    def labels(t: int, length: int) -> dict[str, np.ndarray]:
        return {"next.success": np.array([t == length - 1])}

    # The last episode of each task is held out.
    episodes = [("Pick", 8), ("Place", 5), ("Pick", 7), ("Place", 6)]
    dataset = record(tmp_path / "data" / "robot", FEATURES, episodes, labels)
    record(tmp_path / "data" / "new_tasks", FEATURES, [("Stack", 7)], labels)
    converted = {"image": camera(48, 48), "state": vector(9), "actions": vector(7)}
    record(tmp_path / "data" / "converted", converted, [("Pick", 6)])
    monkeypatch.chdir(tmp_path)
    for words in commands(DOCUMENT):
        if words[0] == "lerobot-rollout" or words[1] in ("replay", "dream", "report"):
            continue
        if words[0] == "lerobot-train":
            monkeypatch.setattr(sys, "argv", small(words))
            lerobot_train.main()
        else:
            assert words[0] == "lerobot-wm"
            lerobot_wm_command(*small(words)[1:])
    runs = {path.name for path in (tmp_path / "outputs").iterdir()}
    assert runs == {"wm", "bc", "blind", "bc_lerobot", "e2e", "iql", "bc_new", "wm_new"}

    keys = (FRONT, WRIST, "observation.state")
    item = dataset[0]
    frame = {**{key: item[key][None] for key in keys}, "task": [item["task"]]}
    acts, adds_rewards = blocks(DOCUMENT, "python")
    names: dict[str, torch.Tensor] = {"frame": frame}
    exec(acts, names)
    assert names["action"].shape == (1, 7)
    exec(adds_rewards, {})
    lerobot_wm_command(
        "train --policy.type=e2e_iql --policy.device=cpu --policy.push_to_hub=false --steps=1 --batch_size=2",
        "--num_workers=0 --dataset.repo_id=user/robot_rewarded --dataset.root=data/robot_rewarded --output_dir=out",
    )
    rewarded = LeRobotDataset("user/robot_rewarded", root="data/robot_rewarded")
    assert np.flatnonzero(rewarded.hf_dataset.with_format("numpy")["next.reward"][:]).tolist() == [
        7,
        12,
        19,
        25,
    ]

"""The commands and the program of docs/your_data.md, in their order, at a size for tests."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts import lerobot_train

from tests.documents import blocks, commands
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


@pytest.mark.slow
def test_the_page_works_as_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lerobot_wm_command: Callable[..., None]
) -> None:
    def labels(t: int, length: int) -> dict[str, np.ndarray]:
        return {"next.success": np.array([t == length - 1])}

    dataset = record(tmp_path / "data" / "robot", FEATURES, [("Pick", 8), ("Place", 5)], labels)
    record(tmp_path / "data" / "new_tasks", FEATURES, [("Stack", 7)], labels)
    converted = {"image": camera(48, 48), "state": vector(9), "actions": vector(7)}
    record(tmp_path / "data" / "converted", converted, [("Pick", 6)])
    monkeypatch.chdir(tmp_path)
    for words in commands(DOCUMENT):
        if words[0] == "lerobot-train":
            monkeypatch.setattr(sys, "argv", small(words))
            lerobot_train.main()
        else:
            assert words[0] == "lerobot-wm"
            lerobot_wm_command(*small(words)[1:])
    runs = {path.name for path in (tmp_path / "outputs").iterdir()}
    assert runs == {"wm", "bc", "bc_lerobot", "e2e", "iql", "bc_new", "wm_new"}

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
    assert np.flatnonzero(rewarded.hf_dataset.with_format("numpy")["next.reward"][:]).tolist() == [7, 12]

"""`lerobot-wm rename`: the same dataset under other names; the messages that lead to it."""

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.commands.rename import rename
from lerobot_wm.policies.common.checks import rename_command
from tests.recording import camera, record, train_flags, vector

NAMES = {
    "image": "observation.images.image",
    "wrist_image": "observation.images.wrist_image",
    "actions": "action",
    "state": "observation.state",
}


@pytest.fixture(scope="module")
def converted(tmp_path_factory: pytest.TempPathFactory) -> LeRobotDataset:
    """Names as openpi's converters write them; a PNG and a video camera."""
    features = {
        "image": camera(64, 64),
        "wrist_image": camera(64, 64, "video"),
        "state": vector(3),
        "actions": vector(2),
    }
    return record(tmp_path_factory.mktemp("converted") / "dataset", features, [("Lift", 8), ("Push", 9)])


def train_new(dataset: LeRobotDataset, folder: Path) -> str:
    return f"--policy.type=e2e_bc --steps=2 --batch_size=4 {train_flags(dataset)} --output_dir={folder}"


def advised(error: BaseException) -> list[str]:
    """The arguments of the command at the end of a message."""
    return shlex.split(str(error).rsplit("lerobot-wm rename ")[-1])


def test_the_command_in_the_message_makes_a_copy_that_trains(
    converted: LeRobotDataset,
    lerobot_wm_command: Callable[..., None],
    lerobot_train_command: Callable[[str], None],
    tmp_path: Path,
) -> None:
    with pytest.raises(ValueError, match="wrist_image") as error:
        lerobot_wm_command("train", train_new(converted, tmp_path / "refused"))
    with pytest.raises(ValueError, match="wrist_image"):
        lerobot_train_command(train_new(converted, tmp_path / "refused_too"))
    known = rename_command("test/recorded", converted.root, NAMES)
    assert advised(error.value) == shlex.split(known)[2:]
    copy = rename(converted, NAMES, "test/recorded", tmp_path / "copy")
    for row in (0, 11, 16):
        ours, theirs = copy[row], converted[row]
        for key in theirs:
            assert (
                torch.equal(ours[NAMES.get(key, key)], theirs[key])
                if key != "task"
                else ours[key] == theirs[key]
            )
    assert {NAMES.get(key, key) for key in converted.meta.stats} == set(copy.meta.stats)
    assert "stats/action/mean" in copy.meta.episodes.column_names or "action" in copy.meta.stats
    lerobot_wm_command("train", train_new(copy, tmp_path / "ours"))
    lerobot_train_command(train_new(copy, tmp_path / "lerobots"))


def test_rename_map_for_a_new_policy_names_the_command(
    converted: LeRobotDataset, lerobot_wm_command: Callable[..., None], tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=r"--policy\.path") as error:
        lerobot_wm_command(
            "train", train_new(converted, tmp_path / "run"), '--rename_map={"actions":"action"}'
        )
    assert '--rename_map={"actions": "action"}' in advised(error.value)


def test_rename_map_for_a_checkpoint_renames_observations_only(
    converted: LeRobotDataset, lerobot_wm_command: Callable[..., None], tmp_path: Path
) -> None:
    copy = rename(converted, NAMES, "test/recorded", tmp_path / "copy")
    lerobot_wm_command("train", train_new(copy, tmp_path / "run"))
    checkpoint = tmp_path / "run/checkpoints/last/pretrained_model"
    names = json.dumps(NAMES).replace(" ", "")
    with pytest.raises(ValueError, match="observations only") as error:
        lerobot_wm_command(
            f"train --policy.path={checkpoint} --steps=2 {train_flags(converted)} --rename_map={names}",
            f"--output_dir={tmp_path / 'further'}",
        )
    assert advised(error.value) == shlex.split(rename_command("test/recorded", converted.root, NAMES))[2:]


def test_unknown_and_equal_names_are_refused(converted: LeRobotDataset, tmp_path: Path) -> None:
    for names, told in (
        ({"picture": "observation.image"}, "picture"),
        ({"index": "number"}, "index"),
        ({"image": "wrist_image"}, "wrist_image"),
    ):
        with pytest.raises(ValueError, match=told):
            rename(converted, names, "test/other", tmp_path / "other")
    assert not any(tmp_path.iterdir())

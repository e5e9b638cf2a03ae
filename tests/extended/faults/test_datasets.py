"""Broken datasets raise an error that names the file before any work is done, without asking the network."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from huggingface_hub.errors import OfflineModeIsEnabled
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.source import DatasetError, SourceConfig, open_dataset
from tests.documents import ROOT
from tests.extended.faults.breakage import DATA, FAULTS, STATS, VIDEO, damage, remove
from tests.extended.faults.conftest import WIDE


def test_a_whole_dataset_passes(whole_dataset: Path) -> None:
    open_dataset("test/faults", whole_dataset)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_dataset_is_refused(fault: str, dataset: Path) -> None:
    break_it, file, facts = FAULTS[fault]
    break_it(dataset)
    with pytest.raises(DatasetError) as refusal:
        open_dataset("test/faults", dataset)
    message = str(refusal.value)
    assert message.startswith(f"{dataset}/{file}")
    assert all(fact in message for fact in facts)
    assert "\n" not in message
    assert len(message) < len(str(dataset)) + 700


def test_missing_statistics_are_recomputed_as_the_message_says(dataset: Path, tmp_path: Path) -> None:
    remove(dataset, STATS)
    with pytest.raises(DatasetError, match=r"lerobot-edit-dataset --operation\.type=recompute_stats"):
        open_dataset("test/faults", dataset)
    copy = tmp_path / "copy"
    flags = f"--repo_id=test/faults --root={dataset} --new_root={copy} --operation.type=recompute_stats"
    command = [sys.executable, "-m", "lerobot.scripts.lerobot_edit_dataset", *flags.split()]
    subprocess.run(command, check=True, capture_output=True)
    open_dataset("test/faults", copy)


def test_damage_inside_the_data_is_found_when_it_is_opened(dataset: Path) -> None:
    damage(dataset, DATA.format(2), "action")
    open_dataset("test/faults", dataset)  # the columns that number frames are whole
    with pytest.raises(DatasetError, match=re.escape(DATA.format(2))):
        SourceConfig("test/faults", str(dataset)).open()


def test_damage_inside_a_video_is_found_when_it_is_decoded(dataset: Path) -> None:
    # As after a bad copy: the header promises frames that are not there.
    path = dataset / VIDEO.format("wide", 1)
    content = path.read_bytes()
    start = content.index(b"mdat") + 4
    size = int.from_bytes(content[start - 8 : start - 4]) - 8
    path.write_bytes(content[:start] + bytes(size) + content[start + size :])
    open_dataset("test/faults", dataset)
    with pytest.raises(DatasetError, match=r"wide/chunk-000/file-001.mp4.* episode 1 "):
        camera_frames(LeRobotDataset("test/faults", root=dataset), WIDE)


def test_a_dataset_that_is_not_here_is_looked_up_on_the_hub(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "nothing", tmp_path / "empty"):
        with pytest.raises(OfflineModeIsEnabled):
            open_dataset("test/faults", folder)


def test_a_download_of_some_episodes_passes(dataset: Path) -> None:
    (dataset / ".cache" / "huggingface").mkdir(parents=True)
    remove(dataset, DATA.format(1))
    remove(dataset, "videos")
    open_dataset("test/faults", dataset)


@pytest.mark.parametrize("all_faults", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_commands_end_in_one_line_and_ask_no_network(
    all_faults: bool, whole_dataset: Path, tmp_path: Path
) -> None:
    lines = []
    # Each command takes a second: by default one after every fourth fault, in turn.
    for number, (break_it, *_) in enumerate(list(FAULTS.values())[:: 1 if all_faults else 4]):
        root = shutil.copytree(whole_dataset, tmp_path / str(number))
        break_it(root)
        flags = ["--dataset.repo_id=test/faults", f"--dataset.root={root}"]
        training = ["--policy.type=wm_rssm", "--policy.push_to_hub=false", "--policy.device=cpu"]
        output = ["--output_repo_id=a/b", f"--output_root={tmp_path / 'out'}"]
        commands = [
            ["train", *flags, *training, f"--output_dir={tmp_path / 'run'}"],
            ["rename", *flags, '--rename_map={"next.reward":"next.success_reward"}', *output],
        ]
        lines += commands if all_faults else [commands[number % 2]]
    environment = {name: value for name, value in os.environ.items() if name != "HF_HUB_OFFLINE"}
    run = subprocess.run(
        [sys.executable, "tests/extended/faults/breakage.py"],
        cwd=ROOT,
        env=environment,
        input="\n".join(map(json.dumps, lines)),
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
    )
    results = [json.loads(line[7:]) for line in run.stdout.splitlines() if line.startswith("RESULT ")]
    assert len(results) == len(lines)
    for (message, connections), (name, *_) in zip(results, lines, strict=True):
        assert connections == []
        assert message.startswith(f"lerobot-wm {name}: {tmp_path}"), message
        assert "\n" not in message
    assert "Traceback" not in run.stderr
    assert not (tmp_path / "run").exists()

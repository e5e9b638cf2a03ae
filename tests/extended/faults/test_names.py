"""Names from elsewhere: as tasks they are text, as repositories and features they are refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from huggingface_hub.errors import HFValidationError
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import save_file

from lerobot_wm.collect.command import CollectConfig
from lerobot_wm.commands.rename import rename
from lerobot_wm.data.cache import camera_frames
from lerobot_wm.data.loader import RamDataset
from lerobot_wm.data.source import open_dataset
from lerobot_wm.policies.common.checkpoint import CheckpointError, open_checkpoint
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.records import record_line
from lerobot_wm.report.command import ReportConfig, report
from tests.extended.faults.breakage import INFO, ONE_NUMBER, set_entry
from tests.extended.faults.conftest import WIDE, write_dataset

SCRIPT = "<script>alert(1)</script><img src=x onerror=alert(2)>"
HOSTILE = (
    "../../outside",
    "/etc/passwd",
    "a/b\\c",
    "\"'`$(touch outside)`;--",
    SCRIPT,
    "\x1b[31m\x07\r\n",
    "x" * 300,
    "データ \u202e",
)


def names_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def test_tasks_of_any_name_are_text(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "in" / "dataset", lengths=(3,) * len(HOSTILE), tasks=HOSTILE)
    before = names_below(tmp_path)
    open_dataset("test/faults", root)
    dataset = LeRobotDataset("test/faults", root=root)
    batch = RamDataset(dataset, torch.device("cpu")).batch(list(range(0, 24, 3)))
    assert batch["task"] == list(HOSTILE)
    copy = rename(dataset, {"next.reward": "next.shaped"}, "test/copy", tmp_path / "in" / "copy")
    assert list(copy.meta.tasks.index) == list(HOSTILE)
    created = names_below(tmp_path) - before
    assert {name.split("/")[1] for name in created} == {"copy", "dataset.cache"}


@pytest.mark.parametrize(
    "name", [name for name in HOSTILE if "/" not in name and "\x1b" not in name and len(name) < 300]
)
def test_folders_of_any_name_are_read(name: str, whole_dataset: Path, tmp_path: Path) -> None:
    root = shutil.copytree(whole_dataset, tmp_path / name)
    open_dataset("test/faults", root)
    assert camera_frames(LeRobotDataset("test/faults", root=root), WIDE).any()
    assert {path.name for path in tmp_path.iterdir()} == {name, f"{name}.cache"}


@pytest.mark.parametrize("name", HOSTILE)
def test_repositories_need_a_name(name: str) -> None:
    with pytest.raises(HFValidationError):
        open_dataset(name)
    with pytest.raises(HFValidationError):
        CollectConfig(repo_id=name)


@pytest.mark.parametrize("name", [name for name in HOSTILE if "/" in name])
def test_features_have_no_slash_in_their_names(name: str, dataset: Path) -> None:
    set_entry(dataset, INFO, ["features", name], ONE_NUMBER)
    with pytest.raises(ValueError, match="slash") as refusal:
        open_dataset("test/faults", dataset)
    assert str(refusal.value).isprintable()


def test_names_in_the_report_are_text(tmp_path: Path) -> None:
    record = {
        "arm": SCRIPT, "policy_type": SCRIPT, "preset": SCRIPT, "seed": 0, "task": SCRIPT, "variation": 0,
        "seen": True, "success": True, "steps": 1, "return": 1.0,
    }  # fmt: skip
    (tmp_path / "records.jsonl").write_text(record_line(record))
    page = report(
        ReportConfig(str(tmp_path / "records.jsonl"), tmp_path / "report", title=SCRIPT)
    ).read_text()
    assert "alert(1)" in page
    assert "<script>alert" not in page
    assert "<img src=x" not in page


@pytest.mark.parametrize(
    "steps",
    [
        [{"class": "subprocess.Popen", "config": {"args": "exit"}}],
        [{"registry_name": "device_processor"}, {"class": "os.system"}],
        [{"registry_name": ["x"]}],
        "subprocess.Popen",
        None,
    ],
)
def test_a_checkpoint_names_no_code(steps: object, tmp_path: Path) -> None:
    WMRSSMConfig(device="cpu").save_pretrained(tmp_path)
    save_file({}, tmp_path / "model.safetensors")
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        (tmp_path / name).write_text(json.dumps({"name": "x", "steps": steps}))
    with pytest.raises(CheckpointError, match="registry_name"):
        open_checkpoint(tmp_path)


def test_training_on_does_not_run_code_of_the_checkpoint(
    whole_dataset: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    checkpoint = tmp_path / "checkpoint"
    WMRSSMConfig(device="cpu", push_to_hub=False).save_pretrained(checkpoint)
    save_file({"x": torch.zeros(1)}, checkpoint / "model.safetensors")
    step = {"class": "pathlib.Path.touch", "config": {"self": str(tmp_path / "ran")}}
    (checkpoint / "policy_preprocessor.json").write_text(json.dumps({"name": "x", "steps": [step]}))
    with pytest.raises(ValueError, match="registry_name"):
        lerobot_wm_command(
            f"train --policy.path={checkpoint} --dataset.repo_id=test/faults --dataset.root={whole_dataset}",
            f"--output_dir={tmp_path / 'run'}",
        )
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["os.system", "../x", "lerobot.policies.act.modeling_act.ACTPolicy", ""])
def test_a_configuration_names_no_type_but_known_ones(name: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"type": name}))
    with pytest.raises(ValueError, match="not registered"):
        PreTrainedConfig.from_pretrained(tmp_path)

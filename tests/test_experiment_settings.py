"""An output folder holds what was made with one preset's settings."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from lerobot_wm.experiment.arms import ARMS
from lerobot_wm.experiment.preset import Preset, check_settings, load_preset


@pytest.fixture
def preset(tmp_path: Path) -> Preset:
    shutil.copytree(Path("configs") / "smoke", tmp_path / "configs" / "smoke")
    return load_preset("smoke", tmp_path / "configs")


def change(preset: Preset, file: str, **settings: object) -> None:
    path = preset.folder / file
    path.write_text(json.dumps(json.loads(path.read_text()) | settings))


def test_changed_settings_are_refused_until_they_are_set_back(preset: Preset, tmp_path: Path) -> None:
    output_dir = tmp_path / "outputs"
    check_settings(preset, output_dir)
    for file, name, value in (("wm_bc.json", "steps", 7), ("experiment.json", "noise", 0.7)):
        original = (preset.folder / file).read_text()
        change(preset, file, **{name: value})
        with pytest.raises(ValueError, match=rf"{name} of .*{file}.* another --output_dir"):
            check_settings(preset, output_dir)
        (preset.folder / file).write_text(original)
        check_settings(preset, output_dir)
    change(preset, "wm_bc.json", steps=7)
    check_settings(preset, tmp_path / "others")


def test_further_arms_seeds_and_settings_files_change_nothing(preset: Preset, tmp_path: Path) -> None:
    check_settings(preset, tmp_path)
    change(preset, "experiment.json", arms={"wm_bc": [0, 1]}, videos_per_task=0)
    (preset.folder / "new_arm.json").write_text("{}")
    check_settings(replace(preset, arms={"wm_bc": [0, 1]}), tmp_path)
    change(preset, "new_arm.json", steps=1)
    with pytest.raises(ValueError, match=r"steps of .*new_arm"):
        check_settings(preset, tmp_path)


def test_an_arm_that_is_defined_otherwise_is_refused(
    preset: Preset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_settings(preset, tmp_path)
    changed = replace(ARMS["wm_bc"], train_flags=("--policy.dropout=0",))
    monkeypatch.setitem(ARMS, "wm_bc", changed)
    with pytest.raises(ValueError, match=r"wm_bc of .*arms\.py.* another --output_dir"):
        check_settings(preset, tmp_path)
    monkeypatch.undo()
    monkeypatch.setitem(ARMS, "further", changed)
    check_settings(preset, tmp_path)


def test_a_folder_of_before_arms_were_noted_is_gone_on_with(preset: Preset, tmp_path: Path) -> None:
    check_settings(preset, tmp_path)
    path = tmp_path / "settings.json"
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "arms"}))
    check_settings(preset, tmp_path)
    assert "wm_bc" in json.loads(path.read_text())["arms"]

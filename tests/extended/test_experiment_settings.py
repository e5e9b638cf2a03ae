"""Presets resolve to complete settings, and an output folder holds results of one preset's settings only."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from lerobot_wm.experiment.preset import Preset, config_file, load_preset, write_settings
from lerobot_wm.report.arms import ARMS, TRAININGS

PRESETS = sorted(file.stem for file in Path("configs").glob("*.json"))


def changed(preset: Preset, training: str, **settings: Any) -> Preset:
    return replace(preset, trainings=preset.trainings | {training: preset.trainings[training] | settings})


@pytest.mark.parametrize("name", PRESETS)
def test_all_bc_policies_of_a_preset_share_their_settings(name: str) -> None:
    """A comparison with policies from scratch or without images is then one of inputs alone."""
    trainings = load_preset(name).trainings
    shared = [
        {key: trainings[training]["policy"].get(key) for key in ("lr_decay_share", "action_noise", "dtype")}
        for training in TRAININGS
        if "_bc" in training
    ]
    assert all(settings == shared[0] for settings in shared)


def test_later_patterns_take_precedence_over_earlier_ones() -> None:
    preset = load_preset("cpu")
    three_seeds = ("wm_iql", "wm_bc", "e2e_iql", "e2e_bc")
    assert preset.arms == {arm: [0, 1, 2] if arm in three_seeds else [0] for arm in ARMS if arm != "joint_bc"}
    assert preset.trainings["e2e_bc_single"] == {
        "policy": {"type": "e2e_bc", "lr_decay_share": 0.5, "push_to_hub": False},
        "batch_size": 128,
        "steps": 3000,
        "save_freq": 1000,
        "log_freq": 100,
    }


def test_the_papers_batches_and_updates() -> None:
    for name, settings in load_preset("paper").trainings.items():
        assert settings["batch_size"] == 256
        assert settings["steps"] == (3_000 if "rssm" in name else 300_000 if "iql" in name else 150_000)


@pytest.mark.parametrize(
    ("changes", "fact"),
    [
        ({"arms": {"mine": [0]}}, "'mine'"),
        ({"trainings": {"*": {"steps": 1}, "e2c_*": {}}}, r"'e2c_\*'"),
    ],
)
def test_settings_without_effect_are_refused(tmp_path: Path, changes: dict, fact: str) -> None:
    data = {**json.loads(Path("configs/smoke.json").read_text()), **changes}
    (tmp_path / "mine.json").write_text(json.dumps(data))
    with pytest.raises(ValueError, match=rf"mine\.json.*{fact}"):
        load_preset("mine", configs=tmp_path)


def test_the_folder_gets_the_resolved_settings(tmp_path: Path) -> None:
    preset = load_preset("smoke")
    write_settings(preset, tmp_path)
    files = {name: json.loads(config_file(tmp_path, name).read_text()) for name in TRAININGS}
    assert files == preset.trainings


def test_changed_settings_are_refused_until_they_are_set_back(tmp_path: Path) -> None:
    preset = load_preset("smoke")
    write_settings(preset, tmp_path)
    before = config_file(tmp_path, "wm_bc").read_text()
    for fact, different in (
        ("wm_bc", changed(preset, "wm_bc", steps=7)),
        ("noise", replace(preset, noise=0.7)),
        ("name", load_preset("quickstart")),
    ):
        with pytest.raises(ValueError, match=rf"{tmp_path} .*{fact}.*--output_dir"):
            write_settings(different, tmp_path)
        assert config_file(tmp_path, "wm_bc").read_text() == before
        write_settings(preset, tmp_path)
    write_settings(changed(preset, "wm_bc", steps=7), tmp_path / "others")


def test_other_arms_videos_and_estimates_change_nothing(tmp_path: Path) -> None:
    preset = load_preset("smoke")
    write_settings(preset, tmp_path)
    write_settings(replace(preset, arms={"wm_bc": [0, 1]}, videos_per_task=0, minutes={}), tmp_path)


def test_a_new_training_is_added_and_its_changes_are_refused_afterwards(tmp_path: Path) -> None:
    preset = load_preset("smoke")
    write_settings(preset, tmp_path)
    more = replace(preset, trainings=preset.trainings | {"mine": {"steps": 1}})
    write_settings(more, tmp_path)
    with pytest.raises(ValueError, match="mine"):
        write_settings(changed(more, "mine", steps=2), tmp_path)


def test_a_changed_arm_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    preset = load_preset("smoke")
    write_settings(preset, tmp_path)
    different = replace(ARMS["wm_bc"], train_flags=("--policy.dropout=0",))
    monkeypatch.setitem(ARMS, "wm_bc", different)
    with pytest.raises(ValueError, match="wm_bc"):
        write_settings(preset, tmp_path)
    monkeypatch.undo()
    monkeypatch.setitem(ARMS, "mine", different)
    monkeypatch.setitem(ARMS, "wm_iql", replace(ARMS["wm_iql"], description="reworded"))
    write_settings(preset, tmp_path)

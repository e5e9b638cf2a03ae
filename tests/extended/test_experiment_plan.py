"""Presets and arms as stages: what needs what, and that every command line is understood by its command."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import draccus
import pytest
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_wm.collect.command import CollectConfig
from lerobot_wm.commands.expert import ExpertConfig
from lerobot_wm.commands.init import InitConfig
from lerobot_wm.constants import MT6
from lerobot_wm.encode.command import EncodeConfig
from lerobot_wm.evaluate.rollouts import EvaluateConfig
from lerobot_wm.experiment.experiment import report_command
from lerobot_wm.experiment.plan import Plan
from lerobot_wm.experiment.preset import load_preset, select_runs, write_settings
from lerobot_wm.experiment.stage import Stage, in_order, unfinished
from lerobot_wm.inspect.quality import QualityConfig
from lerobot_wm.report.arms import ARMS
from lerobot_wm.report.command import ReportConfig
from lerobot_wm.workers import parts_folder, shards_folder

CONFIGS: dict[str, Any] = {
    "collect": CollectConfig,
    "encode": EncodeConfig,
    "eval": EvaluateConfig,
    "expert": ExpertConfig,
    "init": InitConfig,
    "quality": QualityConfig,
    "report": ReportConfig,
    "train": TrainPipelineConfig,
}


@pytest.fixture(scope="module", autouse=True)
def _types() -> None:
    register_third_party_plugins()


def plan(folder: Path, preset: str = "cpu", variation_set: int = 42) -> Plan:
    return Plan(load_preset(preset), folder, variation_set)


def finish(stage: Stage) -> None:
    stage.artefact.parent.mkdir(parents=True)
    stage.artefact.write_text("")


def stages_of(folder: Path, *arms: str, preset: str = "cpu") -> dict[str, Stage]:
    at = plan(folder, preset)
    return in_order(
        stage for arm, seed in select_runs(at.preset, list(arms), [0]) for stage in at.evaluations(arm, seed)
    )


def parse(argv: tuple[str, ...]) -> Any:
    """Read a command line as its command does."""
    assert argv[:3] == (sys.executable, "-m", "lerobot_wm.cli")
    command, *flags = argv[3:]
    # LeRobot reads the checkpoint's own configuration for these two kinds of flags.
    flags = [flag for flag in flags if command != "eval" or not flag.startswith("--policy.")]
    return draccus.parse(CONFIGS[command], args=flags)


def shape(stage: Stage) -> tuple[str, ...]:
    """What decides whether a command line parses: the flags, and the values that name a type or a file of settings."""
    named = ("--config_path=", "--policy.type=")
    return tuple(flag if flag.startswith(named) else flag.partition("=")[0] for flag in stage.argv)


def test_every_command_line_is_understood(tmp_path: Path) -> None:
    at = plan(tmp_path, "smoke", variation_set=43)
    write_settings(at.preset, tmp_path)
    runs = select_runs(at.preset, list(ARMS), [0])
    stages = in_order([*(stage for run in runs for stage in at.evaluations(*run)), at.quality(0)])
    # One command line of each shape: LeRobot takes half a second to read one.
    distinct = {shape(stage): name for name, stage in reversed(stages.items())}
    parsed = {name: parse(stages[name].argv) for name in distinct.values()}
    assert {stages[name].argv[3] for name in parsed} == set(CONFIGS) - {"report"}

    assert parsed["seed_0/wm_iql_sweep"].policy.iql.sweep_betas == [0, 3, 10]
    assert parsed["seed_0/wm_rssm_proprio"].policy.rssm.use_proprio
    assert parsed["seed_0/state_bc"].policy.use_environment_state
    assert not parsed["seed_0/proprio_bc"].policy.use_latent
    button = parsed[f"seed_0/wm_bc_single_{MT6[0]}"]
    assert button.dataset.episodes == [0, 1]
    assert button.dataset.root == str(tmp_path / "seed_0" / "latents_wm_rssm")
    assert button.policy.world_model_path.endswith("seed_0/wm_rssm/checkpoints/000004/pretrained_model")
    for stage in stages.values():
        finish(stage)  # now the report shows everything it can
    report = parse(report_command(at, runs, tmp_path / "records.jsonl", tmp_path / "report"))
    assert "eval_expert" not in report.videos  # it has none
    assert report.world_model_path is not None
    stages["dataset"].artefact.unlink()
    report = parse(report_command(at, runs, tmp_path / "records.jsonl", tmp_path / "report"))
    assert (report.world_model_path, report.dataset) == (None, None), "the demonstrations are gone"


@pytest.mark.parametrize("name", ["cpu", "paper", "smoke"])
def test_a_preset_estimates_all_its_stages(name: str, tmp_path: Path) -> None:
    stages = stages_of(tmp_path, *ARMS, preset=name)
    assert {stage.kind for stage in stages.values()} <= set(load_preset(name).minutes)
    assert not any(stage.is_resumable or stage.is_finished for stage in stages.values())


def test_data_of_each_arm(tmp_path: Path) -> None:
    stages = stages_of(tmp_path, *ARMS)

    def root(run: str) -> str:
        [flag] = [flag for flag in stages[f"seed_0/{run}"].argv if flag.startswith("--dataset.root=")]
        return str(Path(flag.partition("=")[2]).relative_to(tmp_path))

    assert root("wm_rssm") == root("e2e_iql") == root("proprio_bc") == root("state_bc") == "dataset"
    for run in ("e2e_iql_dense", f"e2e_iql_single_dense_{MT6[0]}"):
        assert root(run) == "dataset"
        assert "--policy.reward_key=next.dense_reward" in stages[f"seed_0/{run}"].argv
    assert root("wm_bc") == root("wm_iql_sweep") == root(f"wm_bc_single_{MT6[0]}") == "seed_0/latents_wm_rssm"
    assert root("frozen_bc") == "seed_0/latents_frozen_backbone"
    assert root("joint_bc") == "dataset"
    assert stages["seed_0/wm_rssm"] in stages["seed_0/joint_bc"].needs
    door = ",".join(map(str, range(130, 260)))
    assert f"--dataset.episodes=[{door}]" in stages["seed_0/e2e_bc_single_door-open-v3"].argv


def test_individual_arms_have_a_policy_per_task_and_share_the_rest(tmp_path: Path) -> None:
    stages = stages_of(tmp_path, "wm_bc_single", "wm_bc")
    assert sum(stage.kind == "wm_bc_single" for stage in stages.values()) == len(MT6)
    assert [name for name, stage in stages.items() if stage.kind == "encode"] == ["seed_0/latents_wm_rssm"]


def test_sweep_arms_roll_out_one_training(tmp_path: Path) -> None:
    stages = stages_of(tmp_path, "wm_iql", "wm_iql_beta0", "wm_iql_beta3", "wm_iql_beta10")
    assert [name for name, stage in stages.items() if stage.kind == "wm_iql"] == ["seed_0/wm_iql_sweep"]
    evaluations = [stage for stage in stages.values() if stage.kind == "evaluate"]
    assert len(evaluations) == 4
    assert "--policy.iql.beta=3" in stages["seed_0/eval_wm_iql_beta3"].argv
    assert not [flag for flag in stages["seed_0/eval_wm_iql"].argv if flag.startswith("--policy.iql.beta")]


def test_without_the_sweep_its_actors_are_not_trained(tmp_path: Path) -> None:
    alone = stages_of(tmp_path, "wm_iql", "wm_bc")["seed_0/wm_iql"]
    assert not [flag for flag in alone.argv if "sweep_betas" in flag]
    wanted: dict[str, list[int]] = {"wm_iql": [0, 1], "wm_iql_beta3": [0]}
    at = replace(plan(tmp_path), preset=replace(load_preset("cpu"), arms=wanted))
    runs = select_runs(at.preset, [], [])
    assert [(arm.name, seed) for arm, seed in runs] == [
        (name, seed) for name in wanted for seed in wanted[name]
    ]
    trainings = {stage.name for run in runs for stage in at.policies(*run)}
    assert trainings == {"seed_0/wm_iql_sweep", "seed_1/wm_iql"}


def test_a_finished_policy_needs_no_world_model(tmp_path: Path) -> None:
    stages = stages_of(tmp_path, "wm_bc")
    finish(stages["seed_0/wm_bc"])
    assert list(unfinished([stages["seed_0/eval_wm_bc"]])) == ["seed_0/eval_wm_bc"]


def test_a_training_is_finished_by_its_last_step_only(tmp_path: Path) -> None:
    training = stages_of(tmp_path, "wm_bc")["seed_0/wm_bc"]
    assert "030000" in training.artefact.parts
    assert not training.is_resumable
    assert training.checkpoint is not None
    training.checkpoint.parent.mkdir(parents=True)
    training.checkpoint.write_text("{}")
    assert training.is_resumable
    assert not training.is_finished
    assert "--resume=true" in training.command(cores=1)


def test_a_training_killed_between_two_links_resumes_and_asking_writes_nothing(tmp_path: Path) -> None:
    """LeRobot removes the link `last` and sets it again: a running training may be between the two."""
    training = stages_of(tmp_path, "wm_bc")["seed_0/wm_bc"]
    assert training.checkpoint is not None
    last = training.checkpoint.parents[1]
    saved = last.with_name("000500")
    for file, content in (
        ("pretrained_model/train_config.json", {"scheduler": None}),
        ("training_state/training_step.json", {"step": 500}),
        ("training_state/optimizer_param_groups.json", []),
    ):
        (saved / file).parent.mkdir(parents=True, exist_ok=True)
        (saved / file).write_text(json.dumps(content))
    assert training.is_resumable
    assert "--resume=true" in training.command(cores=1)
    training.prepare()
    assert saved.is_dir()
    assert not last.is_symlink()


def test_collections_and_encodings_resume_with_the_same_command(tmp_path: Path) -> None:
    stages = stages_of(tmp_path, "wm_bc")
    collection, encoding = stages["dataset"], stages["seed_0/latents_wm_rssm"]
    assert collection.checkpoint == shards_folder(parse(collection.argv).output_root)
    assert encoding.checkpoint == parts_folder(parse(encoding.argv).output_root)
    for stage in (collection, encoding):
        begun = stage.command(cores=2)
        stage.checkpoint.mkdir(parents=True)
        assert stage.is_resumable
        assert stage.command(cores=2) == begun


def test_selection_runs_are_kept_apart(tmp_path: Path) -> None:
    arm, expert = ARMS["wm_bc"], ARMS["expert"]
    table, selection = plan(tmp_path), plan(tmp_path, variation_set=43)
    assert table.policies(arm, 0) == selection.policies(arm, 0)
    for each in (arm, expert):
        [shown], [chosen] = table.evaluations(each, 0), selection.evaluations(each, 0)
        assert shown.folder != chosen.folder
    assert "--env.variation_set=43" in selection.evaluations(arm, 0)[0].argv
    assert "--variation_set=42" in in_order(selection.evaluations(arm, 0))["dataset"].argv


def test_data_and_rollouts_have_the_presets_variations(tmp_path: Path) -> None:
    preset = replace(load_preset("cpu"), variations="0-49", variation_set=44)
    [evaluation] = Plan(preset, tmp_path, preset.variation_set).evaluations(ARMS["wm_bc"], 0)
    assert "--env.variation_set=44" in evaluation.argv
    assert evaluation.folder == tmp_path / "seed_0" / "eval_wm_bc"
    collection = in_order([evaluation])["dataset"].argv
    assert {"--variation_set=42", "--variations=0-49"} <= set(collection)
    [other] = Plan(preset, tmp_path, 43).evaluations(ARMS["wm_bc"], 0)
    assert other.folder == tmp_path / "seed_0" / "eval_set43_wm_bc"


def test_data_and_rollouts_have_the_presets_cameras(tmp_path: Path) -> None:
    two = replace(load_preset("cpu"), camera_name="corner2,topview")
    [evaluation] = Plan(two, tmp_path, 42).evaluations(ARMS["wm_bc"], 0)
    assert "--env.camera_name=corner2,topview" in evaluation.argv
    assert "--camera_name=corner2,topview" in in_order([evaluation])["dataset"].argv
    assert load_preset("cpu").camera_name == "corner2"


def test_all_rollouts_have_the_presets_length(tmp_path: Path) -> None:
    short = Plan(replace(load_preset("cpu"), episode_length=70), tmp_path, 42)
    for arm, flag in (("wm_bc", "--env.episode_length=70"), ("expert", "--episode_length=70")):
        [evaluation] = short.evaluations(ARMS[arm], 0)
        assert flag in evaluation.argv


def test_runs_are_chosen_by_arms_and_seeds() -> None:
    preset = load_preset("cpu")

    def chosen(arms: list[str], seeds: list[int]) -> list[tuple[str, int]]:
        return [(arm.name, seed) for arm, seed in select_runs(preset, arms, seeds)]

    assert chosen(["wm_bc"], []) == [("wm_bc", 0), ("wm_bc", 1), ("wm_bc", 2)]
    assert chosen(["expert", "wm_iql"], [4]) == [("wm_iql", 4), ("expert", 0)]
    assert {name for name, _ in chosen([], [])} == set(preset.arms) == set(ARMS) - {"joint_bc"}
    assert chosen(["joint_bc"], []) == [("joint_bc", 0)], "it runs when it is named"
    with pytest.raises(ValueError, match=r"wm_cb.*e2e_iql"):
        select_runs(preset, ["wm_cb"], [])

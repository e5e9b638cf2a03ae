"""The report of an experiment: the command that makes it."""

from pathlib import Path

from lerobot_wm.experiment.arms import Arm
from lerobot_wm.experiment.commands import lerobot_wm
from lerobot_wm.experiment.plan import Plan


def report_command(plan: Plan, runs: list[tuple[Arm, int]], records: Path, folder: Path) -> tuple[str, ...]:
    """`lerobot-wm report` over all records, with the videos and curves of each arm's first seed.

    Args:
        plan: The experiment.
        runs: Its arms and seeds.
        records: The records file.
        folder: Where the report goes.
    """
    first = {arm.name: (arm, seed) for arm, seed in reversed(runs)}.values()
    trained = [(arm, seed) for arm, seed in first if arm.config is not None]  # the expert leaves no videos
    evaluations = [stage for run in trained for stage in plan.evaluations(*run)]
    trainings = [stage for arm, seed in trained if not arm.individual for stage in plan.policies(arm, seed)]
    seed = runs[0][1]
    world_model, quality, dataset = plan.world_model(seed), plan.quality(seed), plan.demonstrations.sparse()
    flags: dict[str, object] = {
        "records": records,
        "output_dir": folder,
        "title": f"World-model policies and controls, preset {plan.preset.name}",
    }
    for flag, stages in (("videos", evaluations), ("train_logs", [world_model.made_by, *trainings])):
        folders = dict.fromkeys(str(stage.folder) for stage in stages if stage.finished)
        if folders:
            flags[flag] = ",".join(folders)
    # Once all is trained the demonstrations may have been removed: the world model is shown on them.
    if world_model.made_by.finished and dataset.made_by.finished:
        flags |= {"world_model_path": world_model.path, **dataset.flags()}
    if quality.finished:
        flags["quality"] = quality.artefact
    return lerobot_wm("report", flags)

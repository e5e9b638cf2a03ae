"""What reaches Weights & Biases, read back from the files of offline runs: no network, no login."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import wandb
from lerobot.configs.default import WandBConfig
from wandb.proto.wandb_internal_pb2 import Record
from wandb.sdk.internal.datastore import DataStore

from lerobot_wm.evaluate.wandb_log import wandb_run
from lerobot_wm.policies.common.checkpoint import split_revision
from tests.flags import DATASET_FLAGS, SMALL_WORLD_MODEL, TRAIN_FLAGS


def offline_run(folder: Path) -> Path:
    """The folder of the one run that was logged under `folder`."""
    [run] = (folder / "wandb").glob("offline-run-*")
    return run


def logged(run: Path) -> dict[str, list[Any]]:
    """What an offline run logged, in order: its values by key; those of media are `<key>.path` and others."""
    wandb.teardown()  # waits for the process of its own that writes the file
    [file] = run.glob("*.wandb")
    store = DataStore()
    store.open_for_scan(str(file))
    found: dict[str, list[Any]] = {}
    while (data := store.scan_data()) is not None:
        for item in Record.FromString(data).history.item:
            key = item.key or ".".join(item.nested_key)
            found.setdefault(key, []).append(json.loads(item.value_json))
    store.close()
    return found


def table(run: Path, key: str) -> dict[str, Any]:
    """A logged table: its columns and data."""
    return json.loads((run / "files" / logged(run)[f"{key}.path"][-1]).read_text())


@pytest.fixture(scope="module")
def tracked_run(
    demos_root: Path, tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Callable[..., None]
) -> Path:
    """The output folder of a world model trained with LeRobot's wandb flags."""
    folder = tmp_path_factory.mktemp("wandb") / "run"
    lerobot_wm_command(
        "train --policy.type=wm_rssm --steps=4 --batch_size=2 --log_freq=2 --save_freq=4",
        f"{TRAIN_FLAGS} {SMALL_WORLD_MODEL} {DATASET_FLAGS.format(root=demos_root)} --output_dir={folder}",
        "--wandb.enable=true --wandb.mode=offline --wandb.project=worlds --wandb.disable_artifact=true",
    )
    wandb.finish()  # which LeRobot leaves to the end of the process
    return folder


def test_training_logs_losses_by_name(tracked_run: Path) -> None:
    found = logged(offline_run(tracked_run))
    lines = [json.loads(line) for line in (tracked_run / "train_log.jsonl").read_text().splitlines()]
    for name in ("loss", "image_loss", "reward_loss", "kl_loss", "kl", "under_free_nats"):
        assert found[f"train/{name}"] == pytest.approx([line[name] for line in lines]), name


def test_a_dream_goes_to_the_run_that_trained_the_checkpoint(
    tracked_run: Path, demos_root: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    lerobot_wm_command(
        f"dream --policy.path={tracked_run}/checkpoints/last/pretrained_model --episode=1 --horizon=4",
        f"{DATASET_FLAGS.format(root=demos_root)} --output_dir={tmp_path} --wandb.enable=true",
    )
    run, training = offline_run(tmp_path), offline_run(tracked_run)
    assert run.name.split("-")[-1] == training.name.split("-")[-1], "the run's id"
    found = logged(run)
    for key, file in (("dream/video", "episode_1.mp4"), ("dream/strip", "episode_1.png")):
        [media] = found[f"{key}.path"]
        assert (run / "files" / media).read_bytes() == (tmp_path / file).read_bytes()
    assert found["dream/psnr"] != found["dream/copy_psnr"]


def test_an_evaluation_logs_its_tables(
    policy_paths: dict[str, Path], tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    # This policy was trained without wandb: the evaluation is a run of its own.
    lerobot_wm_command(
        f"eval --policy.path={policy_paths['wm_bc']} --policy.device=cpu --env.type=metaworld_mt",
        "--env.task=reach-v3 --env.episode_length=3 --eval.n_episodes=2 --seed=10",
        f"--output_dir={tmp_path} --videos_per_task=0 --wandb.enable=true --wandb.mode=offline",
    )
    records = [json.loads(line) for line in (tmp_path / "records.jsonl").read_text().splitlines()]
    run = offline_run(tmp_path)
    rollouts = table(run, "eval/rollouts")
    assert [dict(zip(rollouts["columns"], row, strict=True)) for row in rollouts["data"]] == records
    success = table(run, "eval/success")
    assert success["columns"] == ["task", "unseen", "all"]
    assert success["data"][0][:2] == ["reach-v3", "0/2  0 [0, 66]"]
    found = logged(run)
    assert found["eval/pc_success_unseen"] == found["eval/pc_success_all"] == [0]


def test_flags_choose_another_run(tracked_run: Path, tmp_path: Path) -> None:
    checkpoint = tracked_run / "checkpoints" / "last" / "pretrained_model"
    cfg = WandBConfig(enable=True, mode="offline", project="elsewhere", run_id="mine")
    with wandb_run(cfg, checkpoint, tmp_path) as run:
        assert (run.id, run.project) == ("mine", "elsewhere")


def test_without_the_flag_nothing_is_logged(tracked_run: Path, tmp_path: Path) -> None:
    checkpoint = tracked_run / "checkpoints" / "last" / "pretrained_model"
    with wandb_run(WandBConfig(), checkpoint, tmp_path) as run:
        assert run is None
    assert not list(tmp_path.iterdir())


def test_the_run_is_that_of_the_revision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each revision of a checkpoint on the Hub was trained in a run of its own."""
    repository = tmp_path / "hub" / "models--user--wm"
    for branch, commit in (("main", "a" * 40), ("v1", "b" * 40)):
        (repository / "refs").mkdir(parents=True, exist_ok=True)
        (repository / "refs" / branch).write_text(commit)
        settings = repository / "snapshots" / commit / "train_config.json"
        settings.parent.mkdir(parents=True)
        settings.write_text(json.dumps({"wandb": {"run_id": f"of-{branch}", "mode": "offline"}}))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    for checkpoint, run_id in (("user/wm@v1", "of-v1"), ("user/wm", "of-main")):
        name, revision = split_revision(checkpoint)
        with wandb_run(WandBConfig(enable=True), Path(name), tmp_path / run_id, revision) as run:
            assert run.id == run_id

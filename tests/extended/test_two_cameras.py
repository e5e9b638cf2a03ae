"""Two cameras from collection to rollouts, through the commands a user gives."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader

from lerobot_wm.data.loader import RamLoader
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import load_world_model
from lerobot_wm.inspect.open_loop import CONTEXT, open_loop, strips_figure
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from tests.flags import TRAIN_FLAGS

Command = Callable[..., None]
CAMERAS = ["observation.images.corner2", "observation.images.topview"]
SMALL = "--policy.rssm.deter_dim=16 --policy.rssm.stoch_dim=8 --policy.rssm.hidden_dim=16"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("two_cameras")


@pytest.fixture(scope="module")
def dataset(folder: Path, lerobot_wm_command: Command) -> LeRobotDataset:
    lerobot_wm_command(
        "collect --camera_name=corner2,topview --tasks=window-close-v3,reach-v3 --episodes_per_task=2 --num_workers=1",
        f"--repo_id=test/two --root={folder / 'two'}",
    )
    return LeRobotDataset("test/two", root=folder / "two")


@pytest.fixture(scope="module")
def world_model_path(folder: Path, dataset: LeRobotDataset, lerobot_wm_command: Command) -> Path:
    lerobot_wm_command(
        f"train --policy.type=wm_rssm {SMALL} --policy.window_length=4 --steps=3 --batch_size=2 --log_freq=1",
        f"{TRAIN_FLAGS} --dataset.repo_id=test/two --dataset.root={dataset.root} --output_dir={folder / 'wm'}",
    )
    return folder / "wm" / "checkpoints" / "last" / "pretrained_model"


@pytest.fixture(scope="module")
def policy_path(
    folder: Path, dataset: LeRobotDataset, world_model_path: Path, lerobot_wm_command: Command
) -> Path:
    lerobot_wm_command(
        f"encode --world_model_path={world_model_path} --device=cpu --dataset.repo_id=test/two",
        f"--dataset.root={dataset.root} --output_repo_id=test/latents --output_root={folder / 'latents'}",
    )
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --steps=2 --batch_size=8",
        f"{TRAIN_FLAGS} --dataset.repo_id=test/latents --dataset.root={folder / 'latents'}",
        f"--output_dir={folder / 'bc'}",
    )
    return folder / "bc" / "checkpoints" / "last" / "pretrained_model"


def test_frames_from_ram_equal_lerobots(dataset: LeRobotDataset) -> None:
    windows = {key: [0.0, 1 / 80] for key in (*CAMERAS, "action")}
    source = LeRobotDataset("test/two", root=dataset.root, delta_timestamps=windows, return_uint8=True)
    loader = DataLoader(source, batch_size=3, sampler=[0, 31, source.num_frames - 1])
    [theirs], [ours] = loader, RamLoader(loader, loader.batch_sampler, torch.device("cpu"))
    for key in CAMERAS:
        assert torch.equal(theirs[key], ours[key]), key
    assert not torch.equal(ours[CAMERAS[0]], ours[CAMERAS[1]])


@torch.no_grad()
def test_step_by_step_latents_equal_the_encoded_ones(
    folder: Path, dataset: LeRobotDataset, policy_path: Path
) -> None:
    policy = WMBCPolicy.from_pretrained(policy_path)
    assert policy.config.cameras == CAMERAS
    assert set(policy.config.input_features) == {*CAMERAS, "observation.state"}
    encoded = LeRobotDataset("test/latents", root=folder / "latents")
    assert encoded.meta.camera_keys == []
    policy.reset()
    for t in range(10):
        item = dataset[t]
        frame = {key: item[key][None] for key in (*CAMERAS, "observation.state")}
        policy.select_action({**frame, "task": [item["task"]]})
        stored = encoded[t]["observation.latent"]
        torch.testing.assert_close(policy._filter_state.latent[0], stored, atol=2e-5, rtol=2e-5)
        policy._prev_action = item["action"][None]


@pytest.mark.parametrize("policy_type", ["wm_bc", "e2e_bc"])
def test_rollouts(
    policy_type: str,
    dataset: LeRobotDataset,
    policy_path: Path,
    tmp_path: Path,
    lerobot_wm_command: Command,
) -> None:
    if policy_type == "e2e_bc":
        lerobot_wm_command(
            f"train --policy.type=e2e_bc --policy.image_key={CAMERAS[1]},{CAMERAS[0]} --steps=2 --batch_size=2",
            f"{TRAIN_FLAGS} --dataset.repo_id=test/two",
            f"--dataset.root={dataset.root} --output_dir={tmp_path / 'run'}",
        )
        policy_path = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    flags = f"eval --policy.path={policy_path} --env.type=metaworld_mt --env.task=window-close-v3 --seed=0"
    short = "--env.episode_length=3 --eval.n_episodes=2 --eval.batch_size=2"
    # The order of the environment's cameras does not matter, the names do.
    lerobot_wm_command(flags, short, "--env.camera_name=topview,corner2", f"--output_dir={tmp_path / 'two'}")
    records = [json.loads(line) for line in (tmp_path / "two" / "records.jsonl").read_text().splitlines()]
    assert [record["steps"] for record in records] == [3, 3]
    renamed = '--rename_map={"observation.images.corner":"observation.images.topview"}'
    lerobot_wm_command(
        flags, short, "--env.camera_name=corner2,corner", renamed, f"--output_dir={tmp_path / 'renamed'}"
    )
    lacks = f"{flags} {short} --env.camera_name=corner2,corner --output_dir={tmp_path / 'other'}"
    with pytest.raises(ValueError, match=r"observation\.images\.topview"):
        lerobot_wm_command(lacks)


def test_encoding_needs_every_camera(
    demos_root: Path, world_model_path: Path, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    with pytest.raises(
        ValueError,
        match=r"corner2, .*topview; test/demos has .*observation\.image.*--rename_map",
    ):
        lerobot_wm_command(
            f"encode --world_model_path={world_model_path} --device=cpu --dataset.repo_id=test/demos",
            f"--dataset.root={demos_root} --output_repo_id=test/none --output_root={tmp_path / 'none'}",
        )


def test_latents_of_other_cameras_never_mix(
    dataset: LeRobotDataset,
    world_model_path: Path,
    tmp_path: Path,
    lerobot_wm_command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lerobot_wm.encode.command.check_can_push", lambda repo_id: None)
    # The same weights shown the cameras in another order.
    other = shutil.copytree(world_model_path, tmp_path / "other")
    config = json.loads((other / "config.json").read_text())
    (other / "config.json").write_text(json.dumps(config | {"image_key": ",".join(reversed(CAMERAS))}))

    def encode(path: Path, *flags: str) -> None:
        lerobot_wm_command(
            f"encode --world_model_path={path} --device=cpu --dataset.repo_id=test/two",
            f"--dataset.root={dataset.root} --output_repo_id=user/latents --output_root={tmp_path / 'latents'}",
            *flags,
        )

    here, there = ", ".join(reversed(CAMERAS)), ", ".join(CAMERAS)
    encode(world_model_path, "--shard=1/1")
    with pytest.raises(FileExistsError, match=rf"has latents made with.*cameras {there} there, {here} here"):
        encode(other)
    encode(world_model_path)
    with pytest.raises(FileExistsError, match=rf"has latents made with.*cameras {there} there, {here} here"):
        encode(other, "--push_to_hub=true")


def test_open_loop_strips_show_both_cameras(dataset: LeRobotDataset, world_model_path: Path) -> None:
    results = open_loop(
        load_world_model(str(world_model_path)), dataset.meta, SourceConfig("test/two", str(dataset.root))
    )
    assert results[0].imagined.shape[1:] == (3, 64, 128)
    start = dataset.meta.episodes[0]["dataset_from_index"]
    both = torch.cat([dataset[start + CONTEXT - 1][key] for key in CAMERAS], dim=-1)
    assert torch.equal(torch.from_numpy(results[0].truth[CONTEXT - 1]), both)
    shown = strips_figure(results).axes[0].images[0].get_array()
    assert shown.shape == (64, 128, 3)


def test_quality(
    dataset: LeRobotDataset, world_model_path: Path, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    lerobot_wm_command(
        f"quality --world_model_path={world_model_path} --dataset.repo_id=test/two",
        f"--dataset.root={dataset.root} --output_dir={tmp_path}",
        f"--train_dataset.repo_id=test/two --train_dataset.root={dataset.root}",
    )
    result = json.loads((tmp_path / "quality.json").read_text())
    assert {row["prediction"] for row in result["open_loop"]} >= {"open loop", "closed loop"}
    assert (tmp_path / "quality_examples.png").is_file()

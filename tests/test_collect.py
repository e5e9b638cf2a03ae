"""A small collection, looked at as LeRobot shows it and against the environment it came from."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.collect.command import CollectConfig, collect
from lerobot_wm.collect.shards import Shard, ShardRecord, write_shard
from lerobot_wm.constants import (
    ACTION,
    CAMERA_NAME,
    DENSE_REWARD,
    DONE,
    OBS_ENV_STATE,
    OBS_IMAGE,
    OBS_STATE,
    REWARD,
    SUCCESS,
    TASK_ID,
    VARIATION,
)
from lerobot_wm.data.schema import COLLECTION_RECORD, metaworld_features
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
from lerobot_wm.envs.tasks import task_description, task_id
from lerobot_wm.envs.variations import parse_variations, rand_vec
from lerobot_wm.system import quiet

TASKS = ("reach-v3", "window-close-v3")
EPISODES = 3


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> CollectConfig:
    root = tmp_path_factory.mktemp("collect") / "dataset"
    return CollectConfig(
        repo_id="user/small", root=root, tasks=",".join(TASKS), episodes_per_task=EPISODES, num_workers=1
    )


@pytest.fixture(scope="module")
def dataset(config: CollectConfig) -> LeRobotDataset:
    return LeRobotDataset(config.repo_id, root=collect(config))


def episode(dataset: LeRobotDataset, index: int) -> dict[str, np.ndarray]:
    """All frames of an episode, images decoded from the video as uint8 (T, H, W, 3)."""
    meta = dataset.meta.episodes[index]
    frames = [dataset[t] for t in range(meta["dataset_from_index"], meta["dataset_to_index"])]
    columns = {key: torch.stack([frame[key] for frame in frames]).numpy() for key in dataset.meta.features}
    columns[OBS_IMAGE] = (columns[OBS_IMAGE].transpose(0, 2, 3, 1) * 255).round().astype(np.uint8)
    return columns


def replay(task: str, columns: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """States (T, 39) and raw images (T, H, W, 3) when the recorded actions are executed."""
    env = MetaworldMTEnv(task)
    observation, _ = env.reset(seed=int(columns[VARIATION][0]))
    states, images = [], []
    for action in columns[ACTION]:
        states.append(env.environment_state)
        images.append(observation["pixels"])
        observation, *_ = env.step(action)
    env.close()
    return np.array(states), np.array(images)


def test_opens_with_lerobots_names(dataset: LeRobotDataset) -> None:
    assert dataset.num_episodes == len(TASKS) * EPISODES
    assert dataset.fps == 80
    assert dataset.meta.robot_type == "metaworld"
    for key, feature in metaworld_features(64, [OBS_IMAGE]).items():
        found = dataset.meta.features[key]
        assert (found["dtype"], tuple(found["shape"])) == (feature["dtype"], feature["shape"])
    assert list(dataset.meta.tasks.index) == [task_description(task) for task in TASKS]
    assert dataset.meta.features[OBS_IMAGE]["info"]["video.pix_fmt"] == "yuv444p"
    # With it the same frames do not always give the same file: too rarely to see it in a test.
    assert dataset.meta.features[OBS_IMAGE]["info"]["video.extra_options"] == {"mbtree": 0}


def test_episode_contents(dataset: LeRobotDataset, config: CollectConfig) -> None:
    for index in range(dataset.num_episodes):
        columns = episode(dataset, index)
        task = TASKS[index // EPISODES]
        success = columns[SUCCESS]
        first = int(success.argmax())
        assert len(success) == first + 1 + config.steps_after_success
        np.testing.assert_array_equal(columns[DONE], np.arange(len(success)) >= first)
        np.testing.assert_array_equal(columns[REWARD], success.astype(np.float32))
        assert (columns[DENSE_REWARD] > 0).all()
        assert set(columns[TASK_ID].tolist()) == {task_id(task)}
        assert set(columns[VARIATION].tolist()) == {index % EPISODES}
        assert np.abs(columns[ACTION]).max() <= 1.0
        np.testing.assert_array_equal(columns[OBS_STATE], columns[OBS_ENV_STATE][:, :4])


def test_recorded_actions_are_those_executed(dataset: LeRobotDataset) -> None:
    """Replayed in the environment, they give the recorded states exactly and the decoded images nearly."""
    for index, task in [(1, "reach-v3"), (EPISODES, "window-close-v3")]:
        columns = episode(dataset, index)
        states, images = replay(task, columns)
        np.testing.assert_array_equal(states.astype(np.float32), columns[OBS_ENV_STATE])
        error = np.abs(columns[OBS_IMAGE].astype(int) - images)
        assert error.mean() < 3.0  # of 255
        assert error.mean(axis=(1, 2, 3)).max() < 4.0  # no frame is another one's


def test_noise_makes_episodes_differ(dataset: LeRobotDataset) -> None:
    actions = [episode(dataset, index)[ACTION][:20] for index in range(EPISODES)]
    assert np.abs(actions[0] - actions[1]).mean() > 0.1
    assert np.abs(actions[1] - actions[2]).mean() > 0.1


def red(image: np.ndarray) -> np.ndarray:
    """Pixels that are clearly red: bool of the image's shape without channels."""
    image = image.astype(int)
    return image[..., 0] - image[..., 1:].max(axis=-1) > 60


def goal_pixel(env: MetaworldMTEnv) -> tuple[int, int]:
    """Row and column of the goal's centre in a 64x64 image."""
    camera = env._sim.data.camera(CAMERA_NAME)
    fovy = float(env._sim.model.camera(CAMERA_NAME).fovy[0])
    x, y, z = camera.xmat.reshape(3, 3).T @ (env.environment_state[36:] - camera.xpos)
    focal = 32 / np.tan(np.radians(fovy) / 2)
    # This camera hangs upside down: its up is down the image, its right is left.
    return int(32 + focal * y / -z), int(32 - focal * x / -z)


def test_reach_goal_dot_survives_the_codec(dataset: LeRobotDataset) -> None:
    """Nothing else tells reach-v3's goal; chroma subsampling smears its few red pixels into the table."""
    env = MetaworldMTEnv("reach-v3")
    for index in range(EPISODES):
        raw = env.reset(seed=index)[0]["pixels"]
        row, column = goal_pixel(env)
        around = np.s_[row - 3 : row + 4, column - 3 : column + 4]
        raw, decoded = raw[around], episode(dataset, index)[OBS_IMAGE][0][around]
        assert 2 <= red(raw).sum() <= 8
        assert red(decoded)[red(raw)].all()
        error = np.abs(decoded.astype(int) - raw)
        assert error.mean() < 6
        assert error[red(raw)].mean() < 12
    env.close()


def test_record_of_the_collection(dataset: LeRobotDataset, config: CollectConfig) -> None:
    record = json.loads((config.output_root / "meta" / "collection.json").read_text())
    assert record["config"] == config.identity()
    assert set(record["versions"]) == {"mujoco", "metaworld", "lerobot", "lerobot_policy_wm"}
    assert record["experts"]["reach-v3"] == "SawyerReachV3Policy"
    lengths = [episode["length"] for episode in record["episodes"]]
    assert lengths == list(dataset.meta.episodes["length"])
    assert not list(config.output_root.parent.glob("*.shards"))


def test_complete_dataset_is_left_alone(
    dataset: LeRobotDataset, config: CollectConfig, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in config.output_root.rglob("*")}
    collect(config)
    assert "already complete" in capsys.readouterr().out
    assert before == {path: path.stat().st_mtime_ns for path in config.output_root.rglob("*")}
    other = CollectConfig(**{**vars(config), "noise": 0.1})
    with pytest.raises(FileExistsError, match=r"noise 0.3 there, 0.1 here"):
        collect(other)
    other = CollectConfig(**{**vars(config), "variation_set": 43})
    with pytest.raises(FileExistsError, match=r"variation_set 42 there, 43 here"):
        collect(other)


def test_collection_on_the_second_set(tmp_path: Path) -> None:
    one_shard(tmp_path, task="reach-v3", variation_set=43, variations=(7,))
    shard = LeRobotDataset("shards/reach-v3-00000", root=tmp_path / "reach-v3-00000")
    np.testing.assert_allclose(shard[0][OBS_ENV_STATE][36:], rand_vec("reach-v3", 7, 43)[3:], rtol=1e-6)


def test_collection_by_two_cameras(
    dataset: LeRobotDataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same episode as by one camera, seen by two; each feature holds its own camera's pictures."""
    settings = {"repo_id": "user/two", "root": tmp_path / "two", "tasks": "reach-v3", "num_workers": 1}
    config = CollectConfig(**settings, episodes_per_task=1, camera_name="topview, corner2")
    two = LeRobotDataset("user/two", root=collect(config))
    assert two.meta.camera_keys == ["observation.images.topview", "observation.images.corner2"]
    env = MetaworldMTEnv("reach-v3", camera_name="topview,corner2")
    pixels = env.reset(seed=0)[0]["pixels"]
    env.close()
    for camera, image in pixels.items():
        seen = two[0][f"observation.images.{camera}"].movedim(0, -1).numpy() * 255
        assert np.abs(seen - image).mean() < 3.0  # of 255
    for key in (ACTION, OBS_ENV_STATE):
        assert torch.equal(two[20][key], dataset[20][key])
    record = json.loads((tmp_path / "two" / COLLECTION_RECORD).read_text())
    assert record["config"]["camera_name"] == "topview,corner2"
    collect(CollectConfig(**settings, episodes_per_task=1, camera_name="topview,corner2"))
    assert "already complete" in capsys.readouterr().out
    with pytest.raises(FileExistsError, match=r"camera_name topview,corner2 there, corner2 here"):
        collect(CollectConfig(**settings, episodes_per_task=1))


def test_foreign_folder_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    with pytest.raises(FileExistsError, match="not made by"):
        collect(CollectConfig(repo_id="user/x", root=tmp_path / "thesis"))


def one_shard(folder: Path, **changes: object) -> ShardRecord:
    settings = {
        "task": "door-open-v3",
        "first": 0,
        "count": 1,
        "variation_set": 42,
        "variations": (9, 0),
        "noise": 0.3,
        "steps_after_success": 8,
        "max_attempts": 2,
        "seed": 0,
        "image_size": 64,
        "cameras": ("corner2",),
    }
    shard = Shard(**{**settings, **changes})
    with quiet():
        write_shard(shard, folder)
    return ShardRecord.load(folder / shard.name)


def test_failing_variation_hands_its_episode_on(tmp_path: Path) -> None:
    """The expert fails door-open-v3's variation 9: two attempts are counted, then variation 0 serves."""
    record = one_shard(tmp_path)
    assert record.failures == {9: 2}
    assert [(entry.variation, entry.moved) for entry in record.episodes] == [(0, True)]


def test_hopeless_settings_end_with_advice(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"failed 1 attempts.*Lower --noise"):
        one_shard(tmp_path, task="drawer-open-v3", noise=100.0, variations=(0,), max_attempts=1)
    assert not (tmp_path / "drawer-open-v3-00000").exists()


def test_variations_argument() -> None:
    assert parse_variations("0-3,7, 2") == (0, 1, 2, 3, 7)
    for spec in ("", "5-", "a", "0-50", "9-3"):
        with pytest.raises(ValueError, match="variations is"):
            parse_variations(spec)


@pytest.mark.parametrize(
    ("change", "named"), [({"tasks": "reach"}, "reach-v3"), ({"camera_name": "top"}, "topview")]
)
def test_unknown_names_are_refused_before_work(change: dict[str, str], named: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=named):
        collect(CollectConfig(repo_id="user/x", root=tmp_path / "dataset", **change))
    assert not any(tmp_path.iterdir())

"""Dreams of episodes with two cameras of different sizes, by untrained world models made lively, and as a command."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

from lerobot_wm.constants import ACTION, OBS_ENV_STATE, OBS_STATE, REWARD, SUCCESS, TASK
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.encode.episodes import Episode
from lerobot_wm.inspect.dream import (
    OWN_ACTIONS,
    STEPS_SHOWN,
    TRUE_ACTIONS,
    ZERO_ACTIONS,
    DreamConfig,
    Dreams,
    dream,
    dream_of,
    strip_figure,
    video_frames,
)
from lerobot_wm.inspect.episodes import (
    CheckpointConfig,
    ImaginingPolicy,
    load_episodes,
    load_world_model,
    reward_key,
)
from lerobot_wm.nn.images import resize_images
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_iql.configuration_wm_iql import WMIQLConfig
from lerobot_wm.policies.wm_iql.modeling_wm_iql import WMIQLPolicy
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from lerobot_wm.report.models import dream_clips
from lerobot_wm.world_model.config import RSSMConfig
from tests.extended.report.quality_model import lively_world_model

Command = Callable[..., None]
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
SIZES = {FRONT: (48, 80), WRIST: (64, 64)}
AXES = ["height", "width", "channels"]
LENGTHS = (9, 23, 3)
CONTEXT = 4
TASKS = ["lift it", "drop it"]


def record(root: Path, cameras: dict[str, tuple[int, int]], action_dim: int = 3) -> Path:
    """Episodes of random images, actions and rewards; the task of each is another."""
    features = {
        **{key: {"dtype": "image", "shape": (*size, 3), "names": AXES} for key, size in cameras.items()},
        OBS_STATE: {"dtype": "float32", "shape": (2,), "names": None},
        ACTION: {"dtype": "float32", "shape": (action_dim,), "names": None},
        REWARD: {"dtype": "float32", "shape": (1,), "names": None},
        SUCCESS: {"dtype": "bool", "shape": (1,), "names": None},
    }
    dataset = LeRobotDataset.create("test/dream", 30, features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for episode, length in enumerate(LENGTHS):
        for t in range(length):
            frame: dict[str, Any] = {
                key: rng.integers(0, 256, (*size, 3), np.uint8) for key, size in cameras.items()
            }
            frame[OBS_STATE] = rng.normal(size=2).astype(np.float32)
            frame[ACTION] = rng.uniform(-1, 1, action_dim).astype(np.float32)
            frame[REWARD] = rng.uniform(size=1).astype(np.float32)
            frame[SUCCESS] = np.array([t % 3 == 2])
            dataset.add_frame(frame | {TASK: TASKS[episode % 2]})
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("dream") / "dataset", SIZES)


def make_checkpoint(path: Path, policy_type: str, **settings: Any) -> Path:
    """An untrained checkpoint whose images depend on what the world model saw and did."""
    torch.manual_seed(0)
    cameras = {key: PolicyFeature(FeatureType.VISUAL, (3, *size)) for key, size in SIZES.items()}
    inputs = cameras | {OBS_STATE: PolicyFeature(FeatureType.STATE, (2,))}
    common: dict[str, Any] = {
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (3,))},
        "image_key": f"{FRONT},{WRIST}",
        "device": "cpu",
        "push_to_hub": False,
    }
    rssm = RSSMConfig(
        deter_dim=16, stoch_dim=8, hidden_dim=16, reward_hidden_dim=16, image_channels=6, action_dim=3
    )
    rssm = replace(rssm, predict_reward=settings.pop("predict_reward", True))
    policy: WMRSSMPolicy | LatentPolicy
    if policy_type == "wm_rssm":
        policy = WMRSSMPolicy(WMRSSMConfig(rssm=rssm, input_features=inputs, **common, **settings))
    else:
        config_class = {"wm_bc": WMBCConfig, "wm_iql": WMIQLConfig}[policy_type]
        policy_class = {"wm_bc": WMBCPolicy, "wm_iql": WMIQLPolicy}[policy_type]
        settings = {"use_latent": True, "tasks": TASKS} | settings
        world_model = WMRSSMConfig(rssm=rssm, input_features=inputs, **common)
        if not settings["use_latent"]:
            inputs = {OBS_STATE: inputs[OBS_STATE]}
        if settings.get("use_environment_state"):
            inputs |= {OBS_ENV_STATE: PolicyFeature(FeatureType.ENV, (5,))}
        policy = policy_class(
            config_class(
                world_model=world_model if settings["use_latent"] else None,
                input_features=inputs,
                **common,
                **settings,
            )
        )
    low, high = torch.full((3,), -0.5), torch.full((3,), 1.5)
    if policy_type != "wm_rssm":
        policy.action_scaling.set_range(low, high)
    policy.save_pretrained(path)
    if policy_type == "wm_rssm" or settings["use_latent"]:
        policy.world_model.load_state_dict(lively_world_model(path).state_dict())
        policy.world_model.action_scaling.set_range(low, high)  # zero is not the middle of the range
        policy.save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    types = ("wm_rssm", "wm_bc", "wm_iql")
    return {name: make_checkpoint(tmp_path_factory.mktemp(name), name) for name in types}


def episode_of(policy: ImaginingPolicy, root: Path, index: int) -> Episode:
    return load_episodes(policy, SourceConfig("test/dream", str(root)), [index])[0]


@pytest.fixture(scope="module")
def dreams(root: Path, checkpoints: dict[str, Path]) -> Dreams:
    policy = load_world_model(str(checkpoints["wm_bc"]))
    return dream(policy, episode_of(policy, root, 1), CONTEXT)


def test_episodes_are_read_at_the_models_size(root: Path, checkpoints: dict[str, Path]) -> None:
    policy, dataset = load_world_model(str(checkpoints["wm_rssm"])), LeRobotDataset("test/dream", root=root)
    read = load_episodes(policy, SourceConfig("test/dream", str(root)), [0, 1, 2], 20)
    assert [len(episode) for episode in read] == [9, 20, 3]
    for episode in read:
        first = sum(LENGTHS[: episode.index])
        frames = [dataset[first + t] for t in range(len(episode))]
        for key in (ACTION, OBS_STATE):
            assert torch.equal(episode.columns[key], torch.stack([frame[key] for frame in frames]))
        of_cameras = [resize_images(torch.stack([frame[key] for frame in frames]), (64, 64)) for key in SIZES]
        torch.testing.assert_close(episode.images(), torch.cat(of_cameras, dim=1))
        assert episode.task == frames[0][TASK]


@pytest.mark.parametrize("policy_type", ["wm_bc", "wm_iql"])
@torch.no_grad()
def test_dreams_equal_one_step_at_a_time(policy_type: str, root: Path, checkpoints: dict[str, Path]) -> None:
    policy = load_world_model(str(checkpoints[policy_type]))
    episode = episode_of(policy, root, 1)
    dreams = dream(policy, episode, CONTEXT)
    model, actions = policy.world_model, episode.actions
    dataset = LeRobotDataset("test/dream", root=root)

    # The policy's own filter sees the context, as in a rollout in which the episode's actions are executed.
    policy.reset()
    for t in range(CONTEXT):
        item = dataset[LENGTHS[0] + t]
        frame = {key: item[key][None] for key in (*SIZES, OBS_STATE)} | {TASK: [item[TASK]]}
        own = policy.select_action(frame)
        policy._prev_action = actions[t : t + 1]
    seen, held = policy._filter_state, frame[OBS_STATE]

    states = dict.fromkeys((TRUE_ACTIONS, ZERO_ACTIONS, OWN_ACTIONS), seen)
    for t in range(CONTEXT, LENGTHS[1]):
        executed = {
            TRUE_ACTIONS: actions[t - 1 : t],
            ZERO_ACTIONS: torch.zeros(1, 3),
            OWN_ACTIONS: own,
        }
        for name, action in executed.items():
            states[name] = model.imagine(states[name], action[:, None]).last()
            latent = states[name].latent
            imagined = dreams.by_actions[name]
            torch.testing.assert_close(imagined.images[t], model.decode(latent)[0], atol=1e-4, rtol=0)
            torch.testing.assert_close(imagined.reward[t], model.predict_reward(latent)[0], atol=1e-4, rtol=0)
        task = torch.eye(2)[[1]]
        mean = policy.actor_chunk(policy.observation(held, task, states[OWN_ACTIONS].latent))[:, 0]
        own = policy.action_scaling.inverse(mean.clamp(-1, 1))

    pictures = [imagined.images[-1] for imagined in dreams.by_actions.values()]
    assert min((a - b).abs().max() for a, b in pairwise(pictures)) > 1e-3
    for imagined in dreams.by_actions.values():
        torch.testing.assert_close(
            imagined.images[CONTEXT - 1], model.decode(seen.latent)[0], atol=1e-4, rtol=0
        )


@pytest.mark.parametrize("key", [OBS_STATE, OBS_ENV_STATE])
def test_the_policy_does_not_see_where_the_demonstration_goes(key: str, root: Path, tmp_path: Path) -> None:
    path = make_checkpoint(tmp_path, "wm_bc", use_environment_state=key == OBS_ENV_STATE)
    policy = load_world_model(str(path))
    read = episode_of(policy, root, 1)
    episode = replace(read, columns=read.columns | {OBS_ENV_STATE: torch.randn(LENGTHS[1], 5)})

    def own(changed_frame: int) -> torch.Tensor:
        values = episode.columns[key].clone()
        values[changed_frame] += 10
        changed = replace(episode, columns=episode.columns | {key: values})
        return dream(policy, changed, CONTEXT).by_actions[OWN_ACTIONS].images

    same = dream(policy, episode, CONTEXT).by_actions[OWN_ACTIONS].images
    assert torch.equal(own(CONTEXT), same)
    assert not torch.equal(own(CONTEXT - 1), same)


def test_psnr_is_of_the_imagined_frames(dreams: Dreams) -> None:
    truth = torch.zeros(4, 3, 2, 2)
    truth[1] = 1  # the last frame seen
    imagined = replace(dreams.by_actions[TRUE_ACTIONS], images=torch.full_like(truth, 0.1))
    made = replace(dreams, context=2, n_cameras=1, truth=truth, by_actions={TRUE_ACTIONS: imagined})
    assert made.psnr() == pytest.approx(20)
    assert made.copy_psnr() == pytest.approx(0)


def test_strip_shows_steps_and_reward(dreams: Dreams) -> None:
    figure = strip_figure(dreams)
    *pictures, rewards = figure.axes
    columns = np.array(pictures, dtype=object).reshape(4, STEPS_SHOWN + 1)
    assert [axes.get_title() for axes in columns[0]][:2] == ["last seen", "+2"]
    assert columns[0, -1].get_title() == f"+{LENGTHS[1] - CONTEXT}"
    for row, images in enumerate(
        [dreams.truth, *(imagined.images for imagined in dreams.by_actions.values())]
    ):
        # The second camera below the first.
        picture = torch.cat([images[CONTEXT + 1, :3], images[CONTEXT + 1, 3:]], dim=1).movedim(0, -1)
        shown = columns[row, 1].images[0].get_array()
        np.testing.assert_array_equal(shown, (255 * picture).round().byte())
    curves = {line.get_label(): line for line in rewards.lines}
    # The true reward of frame t arrives with frame t + 1, which is where it is predicted.
    np.testing.assert_array_equal(curves["truth (next.reward)"].get_xdata(), range(1, LENGTHS[1]))
    np.testing.assert_array_equal(curves["truth (next.reward)"].get_ydata(), dreams.reward[:-1])
    for name, imagined in dreams.by_actions.items():
        np.testing.assert_array_equal(curves[name].get_xdata(), range(1, LENGTHS[1]))
        np.testing.assert_array_equal(curves[name].get_ydata(), imagined.reward[1:])


def test_the_true_reward_is_of_the_column_that_the_model_learned(root: Path, tmp_path: Path) -> None:
    path = make_checkpoint(tmp_path / "wm", "wm_rssm", reward_key=SUCCESS)
    config = DreamConfig(
        CheckpointConfig(str(path)), SourceConfig("test/dream", str(root)), 1, CONTEXT, output_dir=tmp_path
    )
    dreams = dream_of(config)
    assert dreams.reward.tolist() == [float(t % 3 == 2) for t in range(LENGTHS[1])]
    [curve] = [line for line in strip_figure(dreams).axes[-1].lines if "truth" in line.get_label()]
    assert curve.get_label() == "truth (next.success)"


def test_a_policy_knows_the_reward_of_its_world_model(tmp_path: Path) -> None:
    path = make_checkpoint(tmp_path, "wm_bc")
    settings = json.loads((path / "config.json").read_text())
    settings["world_model"]["reward_key"] = SUCCESS
    (path / "config.json").write_text(json.dumps(settings))
    assert reward_key(load_world_model(str(path))) == SUCCESS


def test_without_a_reward_head_there_is_no_curve(root: Path, tmp_path: Path) -> None:
    policy = load_world_model(str(make_checkpoint(tmp_path, "wm_rssm", predict_reward=False)))
    dreams = dream(policy, episode_of(policy, root, 0), CONTEXT)
    assert list(dreams.by_actions) == [TRUE_ACTIONS, ZERO_ACTIONS]
    assert len(strip_figure(dreams).axes) == 3 * (LENGTHS[0] - CONTEXT + 1)


def test_clips_are_of_tasks_that_the_policy_knows(
    root: Path, checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    meta, source = LeRobotDatasetMetadata("test/dream", root=root), SourceConfig("test/dream", str(root))
    clips = dream_clips(load_world_model(str(checkpoints["wm_bc"])), meta, source)
    assert [(clip.episode.task, clip.episode.index, clip.dreams.n_imagined) for clip in clips] == [
        ("lift it", 0, LENGTHS[0] - 5),
        ("drop it", 1, LENGTHS[1] - 5),
    ], "the last episode of each task that is longer than what is seen"
    assert list(clips[0].dreams.by_actions) == [TRUE_ACTIONS, ZERO_ACTIONS, OWN_ACTIONS]
    stranger = make_checkpoint(tmp_path, "wm_bc", tasks=["drop it", "iron it"])
    assert [clip.episode.task for clip in dream_clips(load_world_model(str(stranger)), meta, source)] == [
        "drop it"
    ]


def test_video_frames_show_truth_and_dreams_side_by_side(dreams: Dreams) -> None:
    frames = video_frames(dreams)
    assert len(frames) == LENGTHS[1]
    assert {frame.shape for frame in frames} == {(2 * 256 + 56, 4 * (256 + 8) + 8, 3)}
    for i, images in enumerate([dreams.truth, *(imagined.images for imagined in dreams.by_actions.values())]):
        left = 8 + i * 264
        wrist = frames[10][28 + 256 : 28 + 512 : 4, left : left + 256 : 4]
        np.testing.assert_array_equal(wrist, (255 * images[10, 3:].movedim(0, -1)).round().byte())
    # Had the model seen one frame more, only the words beneath that one and those imagined would be others.
    later = video_frames(replace(dreams, context=CONTEXT + 1))
    same = [np.array_equal(a, b) for a, b in zip(frames, later, strict=True)]
    assert same == [t < CONTEXT for t in range(LENGTHS[1])]


def flags(checkpoint: Path, root: Path, output_dir: Path) -> str:
    dataset = f"--dataset.repo_id=test/dream --dataset.root={root}"
    return f"dream --policy.path={checkpoint} {dataset} --output_dir={output_dir}"


def test_command(
    root: Path,
    checkpoints: dict[str, Path],
    dreams: Dreams,
    tmp_path: Path,
    lerobot_wm_command: Command,
    capsys: pytest.CaptureFixture,
) -> None:
    lerobot_wm_command(flags(checkpoints["wm_bc"], root, tmp_path), f"--episode=1 --context={CONTEXT}")
    line = capsys.readouterr().out.splitlines()[-1]
    assert f"PSNR {dreams.psnr():.1f} dB under true actions, {dreams.copy_psnr():.1f} dB" in line
    assert line.startswith(f"{LENGTHS[1] - CONTEXT} steps")
    assert str(tmp_path / "episode_1.mp4") in line
    assert str(tmp_path / "episode_1.png") in line
    assert Image.open(tmp_path / "episode_1.png").width > 500
    with av.open(str(tmp_path / "episode_1.mp4")) as video:
        shown = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    expected = video_frames(dreams)
    assert len(shown) == len(expected)
    assert np.abs(shown[-1].astype(float) - expected[-1]).mean() < 10


def test_a_horizon_ends_the_dream(
    root: Path, checkpoints: dict[str, Path], tmp_path: Path, lerobot_wm_command: Command
) -> None:
    lerobot_wm_command(flags(checkpoints["wm_rssm"], root, tmp_path), "--episode=0 --context=2 --horizon=3")
    with av.open(str(tmp_path / "episode_0.mp4")) as video:
        assert len(list(video.decode(video=0))) == 5


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("--episode=3", r"test/dream.* 3 .*\[3\].*0 to 2"),
        ("--episode=-1", r"\[-1\].*0 to 2"),
        ("--episode=2", r"--context=5.*episode 2 has 3 frames"),
        ("--episode=0 --horizon=5", r"--context=5, --horizon=5.*episode 0 has 9 frames"),
        ("--episode=0 --horizon=0", r"--horizon=0"),
        ("--episode=0 --context=0", r"--context=0"),
    ],
)
def test_episodes_that_cannot_be_dreamt(
    wrong: str,
    message: str,
    root: Path,
    checkpoints: dict[str, Path],
    tmp_path: Path,
    lerobot_wm_command: Command,
) -> None:
    with pytest.raises(ValueError, match=message):
        lerobot_wm_command(flags(checkpoints["wm_rssm"], root, tmp_path), wrong)
    assert not list(tmp_path.iterdir())


def test_checkpoints_that_cannot_dream(root: Path, tmp_path: Path, lerobot_wm_command: Command) -> None:
    blind = make_checkpoint(tmp_path / "blind", "wm_bc", use_latent=False)
    with pytest.raises(ValueError, match=r"\(wm_bc\) holds no world model"):
        lerobot_wm_command(flags(blind, root, tmp_path), "--episode=0")
    stranger = make_checkpoint(tmp_path / "stranger", "wm_bc", tasks=["fold it", "iron it"])
    with pytest.raises(ValueError, match=r"Unknown task \['lift it'\]"):
        lerobot_wm_command(flags(stranger, root, tmp_path), "--episode=0")


def test_datasets_that_cannot_be_dreamt_of(
    checkpoints: dict[str, Path], tmp_path: Path, lerobot_wm_command: Command
) -> None:
    one_camera = record(tmp_path / "one", {FRONT: (48, 80)})
    with pytest.raises(
        ValueError, match=r"observation\.images\.wrist.*test/dream.*observation\.images\.front"
    ):
        lerobot_wm_command(flags(checkpoints["wm_rssm"], one_camera, tmp_path), "--episode=0")
    other_robot = record(tmp_path / "robot", SIZES, action_dim=5)
    with pytest.raises(ValueError, match=r"'action'.* 3\b.*test/dream.* 5\b"):
        lerobot_wm_command(flags(checkpoints["wm_rssm"], other_robot, tmp_path), "--episode=0")

import re
import shutil
import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file
from torch import Tensor

from lerobot_wm.data.cache import CACHE_VARIABLE
from lerobot_wm.data.latents import LatentKind, LatentRecord
from lerobot_wm.encode.dataset import encode_to_cache, episode_batches, filter_batches
from lerobot_wm.policies.common.iql import IQLConfig
from lerobot_wm.policies.latent.policy import LatentPolicy, load_encoder
from lerobot_wm.policies.wm_iql.modeling_wm_iql import WMIQLPolicy
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS

POLICY_TYPES = ("wm_bc", "wm_iql")


def load(policy_paths: dict[str, Path], policy_type: str) -> LatentPolicy:
    return get_policy_class(policy_type).from_pretrained(policy_paths[policy_type])


def frame(demos: LeRobotDataset, index: int) -> dict:
    item = demos[index]
    keys = ("observation.image", "observation.state")
    return {**{key: item[key][None] for key in keys}, "task": [item["task"]]}


def replay(policy: LatentPolicy, demos: LeRobotDataset, episode: int) -> Tensor:
    """s_t as the policy's own filter sees an episode, step by step, with the demonstrated actions executed."""
    rows = demos.meta.episodes[episode]
    policy.reset()
    latents = []
    for index in range(rows["dataset_from_index"], rows["dataset_to_index"]):
        policy.select_action(frame(demos, index))
        policy._prev_action = demos[index]["action"][None]
        latents.append(policy._filter_state.latent[0])
    return torch.stack(latents)


def test_step_by_step_latents_equal_the_encoded_ones(
    demos: LeRobotDataset, latents_root: Path, policy_paths: dict[str, Path]
) -> None:
    encoded = LeRobotDataset("test/latents", root=latents_root)
    policy = load(policy_paths, "wm_bc")
    first = replay(policy, demos, 0)
    second = replay(policy, demos, 5)  # after another episode: nothing of it may remain
    for episode, latents in ((0, first), (5, second)):
        rows = encoded.meta.episodes[episode]
        stored = torch.stack(
            encoded.hf_dataset["observation.latent"][rows["dataset_from_index"] : rows["dataset_to_index"]]
        )
        torch.testing.assert_close(latents, stored, atol=2e-5, rtol=2e-5)


def test_the_filter_runs_at_the_precision_of_the_encoded_latents(
    demos: LeRobotDataset, policy_paths: dict[str, Path]
) -> None:
    """Also where LeRobot's training evaluates, in the precision of training."""
    policy = load(policy_paths, "wm_bc")
    latents = []
    for enabled in (False, True):
        policy.reset()
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled):
            policy.select_action(frame(demos, 0))
        latents.append(policy._filter_state.latent)
    assert torch.equal(*latents)


def test_latent_dataset_keeps_everything_but_the_images(demos: LeRobotDataset, latents_root: Path) -> None:
    encoded = LeRobotDataset("test/latents", root=latents_root)
    assert encoded.meta.camera_keys == []
    assert encoded.meta.features["observation.latent"]["shape"] == (512,)
    assert set(demos.features) - set(encoded.features) == {"observation.image"}
    for index in (0, 100, demos.num_frames - 1):
        ours, theirs = encoded[index], demos[index]
        for key in ours.keys() - {"observation.latent", "task"}:
            assert torch.equal(ours[key], theirs[key]), key
        assert ours["task"] == theirs["task"]
    record = LatentRecord.read(latents_root)
    assert record.tasks == ["Reach a goal position", "Push and close a window"]


def test_the_frozen_world_model_is_laid_out_like_its_images(policy_paths: dict[str, Path]) -> None:
    """Else each decision copies all of its weights, which takes longer than all else."""
    weights = [weight for weight in load(policy_paths, "wm_bc").world_model.parameters() if weight.ndim == 4]
    assert weights
    assert all(weight.is_contiguous(memory_format=torch.channels_last) for weight in weights)


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_checkpoint_is_self_contained(
    policy_type: str,
    policy_paths: dict[str, Path],
    world_model_path: Path,
    demos: LeRobotDataset,
    tmp_path: Path,
) -> None:
    copy = tmp_path / "elsewhere"
    shutil.copytree(policy_paths[policy_type], copy)
    config = copy / "config.json"
    config.write_text(config.read_text().replace(str(world_model_path), "gone"))
    policy = get_policy_class(policy_type).from_pretrained(copy)
    actions = policy.select_action(frame(demos, 0))
    assert actions.shape == (1, 4)
    assert (actions.abs() <= 1 + 1e-6).all()
    assert not policy.world_model.training
    weights = load_file(world_model_path / "model.safetensors")
    for name, tensor in policy.world_model.state_dict().items():
        assert torch.equal(tensor, weights[f"world_model.{name}"]), name


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_the_heads_alone_are_switched_to_training(policy_type: str, policy_paths: dict[str, Path]) -> None:
    policy = load(policy_paths, policy_type)
    for mode in (True, False):
        policy.train(mode)
        assert policy.training == mode
        assert {module.training for module in policy.modules()} == {mode}
    assert not any(module.training for module in policy.train().world_model.modules())


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_a_second_episode_equals_a_fresh_one(
    policy_type: str, policy_paths: dict[str, Path], demos: LeRobotDataset
) -> None:
    policy = load(policy_paths, policy_type)

    def act() -> Tensor:
        policy.reset()
        return torch.cat([policy.select_action(frame(demos, index)) for index in range(5)])

    first = act()
    assert torch.equal(first, act())
    assert first.unique(dim=0).shape[0] == 5


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_actions_do_not_depend_on_the_batch(
    policy_type: str, policy_paths: dict[str, Path], demos: LeRobotDataset
) -> None:
    policy = load(policy_paths, policy_type)
    frames = [[frame(demos, start + t) for t in range(4)] for start in (0, 60, 300)]
    alone = []
    for episode in frames:
        policy.reset()
        alone.append(torch.cat([policy.select_action(step) for step in episode]))
    policy.reset()
    together = []
    for t in range(4):
        steps = [episode[t] for episode in frames]
        batch = {
            key: torch.cat([step[key] for step in steps])
            for key in ("observation.image", "observation.state")
        }
        together.append(policy.select_action({**batch, "task": [step["task"][0] for step in steps]}))
    torch.testing.assert_close(torch.stack(together, 1), torch.stack(alone), atol=1e-5, rtol=1e-4)


def test_only_the_policys_own_networks_are_trained(policy_paths: dict[str, Path]) -> None:
    for policy_type in POLICY_TYPES:
        policy = load(policy_paths, policy_type)
        assert not any(p.requires_grad for p in policy.world_model.parameters())
        frozen = set(policy.world_model.modules())
        assert not frozen & set(policy.modules())
        assert not any(name.startswith("world_model") for name, _ in policy.named_parameters())


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_the_frozen_world_model_is_saved_copied_and_moved_though_no_walk_meets_it(
    policy_type: str, policy_paths: dict[str, Path], tmp_path: Path
) -> None:
    policy = load(policy_paths, policy_type).train()
    names = {name for name in policy.state_dict() if name.startswith("world_model.")}
    assert names == {f"world_model.{name}" for name in policy.world_model.state_dict()}
    policy.save_pretrained(tmp_path)
    assert load_file(tmp_path / "model.safetensors").keys() == policy.state_dict().keys()
    copy = deepcopy(policy)
    assert copy.world_model is not policy.world_model
    assert not set(copy.world_model.modules()) & set(copy.modules())
    for name, tensor in policy.state_dict().items():
        assert torch.equal(copy.state_dict()[name], tensor), name
    copy.to("meta")
    assert {tensor.device.type for tensor in copy.state_dict().values()} == {"meta"}


def test_iql_targets_follow_the_critics(policy_paths: dict[str, Path]) -> None:
    policy = load(policy_paths, "wm_iql")
    assert isinstance(policy, WMIQLPolicy)
    agent = policy.agent
    pairs = list(zip(agent.target_critic.parameters(), agent.critic.parameters(), strict=True))
    assert any(not torch.equal(target, source) for target, source in pairs)  # they lag after 20 steps
    before = [target.clone() for target, _ in pairs]
    policy.update()
    for old, (target, source) in zip(before, pairs, strict=True):
        torch.testing.assert_close(target, old + policy.config.iql.target_rate * (source - old))


def test_training_on_images_encodes_them_first(
    demos_root: Path,
    latents_root: Path,
    world_model_path: Path,
    policy_paths: dict[str, Path],
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
) -> None:
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --steps=20 --batch_size=32",
        f"--log_freq=10 --save_freq=10 {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)}",
        f"--output_dir={tmp_path / 'run'}",
    )
    cached = list(demos_root.with_name("dataset.cache").glob("latents-*"))
    assert len(cached) == 1
    assert LatentRecord.read(cached[0]) == LatentRecord.read(latents_root)
    # the same latents in the same order give the same policy as training on the encoded dataset
    ours = load_file(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")
    for name, tensor in load_file(policy_paths["wm_bc"] / "model.safetensors").items():
        assert torch.equal(tensor, ours[name]), name


def test_plain_lerobot_train_on_latents(
    latents_root: Path, world_model_path: Path, tmp_path: Path, lerobot_train_command: Callable[[str], None]
) -> None:
    flags = (
        f"--policy.type=wm_iql --policy.world_model_path={world_model_path} --steps=2 --batch_size=8 {TRAIN_FLAGS} "
        f"--dataset.repo_id=test/latents --dataset.root={latents_root} --output_dir={tmp_path / 'run'}"
    )
    lerobot_train_command(flags)
    WMIQLPolicy.from_pretrained(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model")


def test_blind_control_reads_no_image(
    latents_root: Path, demos: LeRobotDataset, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.use_latent=false --steps=5 --batch_size=8 {TRAIN_FLAGS}",
        f"--dataset.repo_id=test/latents --dataset.root={latents_root} --output_dir={tmp_path / 'run'}",
    )
    checkpoint = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    policy = get_policy_class("wm_bc").from_pretrained(checkpoint)
    seen = frame(demos, 0)
    action = policy.select_action(seen)
    assert torch.equal(action, policy.select_action({**seen, "observation.image": torch.zeros(1, 3, 9, 9)}))
    assert (checkpoint / "model.safetensors").stat().st_size < 1_000_000


def test_a_policy_without_memory_reads_each_frame_by_itself(
    world_model_path: Path,
    latents_root: Path,
    demos: LeRobotDataset,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
) -> None:
    train = f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} {TRAIN_FLAGS}"
    train += " --policy.use_memory=false --steps=2 --batch_size=8"
    with pytest.raises(ValueError, match="encoded with --use_memory=True"):
        lerobot_wm_command(
            f"{train} --dataset.repo_id=test/latents --dataset.root={latents_root}",
            f"--output_dir={tmp_path / 'refused'}",
        )
    lerobot_wm_command(
        f"{train} --dataset.repo_id=test/demos --dataset.root={demos.root}",
        f"--output_dir={tmp_path / 'run'}",
    )
    policy = get_policy_class("wm_bc").from_pretrained(tmp_path / "run/checkpoints/last/pretrained_model")
    action = policy.select_action(frame(demos, 5))
    policy.select_action(frame(demos, 0))
    assert torch.equal(policy.select_action(frame(demos, 5)), action)

    encoder = load_encoder(str(world_model_path))
    [latents] = filter_batches(encoder, demos, episode_batches(demos), kind=LatentKind(use_memory=False))
    assert latents.shape == (demos.num_frames, 1, policy.config.latent_dim)
    seen = frame(demos, 5)
    observation = policy.observation(seen["observation.state"], policy.one_hot_tasks(seen, 1), latents[5])
    torch.testing.assert_close(
        policy.act(observation, seen["observation.state"]), action, atol=1e-4, rtol=1e-4
    )


def test_unknown_task(policy_paths: dict[str, Path], demos: LeRobotDataset) -> None:
    policy = load(policy_paths, "wm_bc")
    with pytest.raises(ValueError, match=r"Unknown task \['Juggle'\].*Reach a goal position"):
        policy.select_action({**frame(demos, 0), "task": ["Juggle"]})


def test_other_image_size(policy_paths: dict[str, Path], demos: LeRobotDataset) -> None:
    policy = load(policy_paths, "wm_bc")
    with pytest.raises(ValueError, match=r"\(3, 96, 96\).*\(3, 64, 64\).*--env\.image_size=64"):
        policy.select_action({**frame(demos, 0), "observation.image": torch.zeros(1, 3, 96, 96)})


def test_other_action_size(policy_paths: dict[str, Path]) -> None:
    config = load(policy_paths, "wm_bc").config
    config.output_features["action"].shape = (7,)
    with pytest.raises(ValueError, match=r"4-d actions.*7-d"):
        config.validate_features()


def refused(flags: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The error `lerobot-train` ends with on these flags, before any training."""
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags.split(), "--steps=1", *TRAIN_FLAGS.split()])
    with pytest.raises(ValueError) as error:  # noqa: PT011 - the callers look at the message
        lerobot_train.main()
    return str(error.value)


def test_latents_of_another_world_model(
    latents_root: Path, world_model_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = world_model_path.parents[1].parent / "checkpoints" / "000006" / "pretrained_model"
    message = refused(
        f"--policy.type=wm_bc --policy.world_model_path={earlier} --dataset.repo_id=test/latents "
        f"--dataset.root={latents_root} --output_dir={tmp_path / 'run'}",
        monkeypatch,
    )
    assert "of world model" in message


def test_images_without_latents(
    demos_root: Path, world_model_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = refused(
        f"--policy.type=wm_bc --policy.world_model_path={world_model_path} {DATASET_FLAGS.format(root=demos_root)} "
        f"--output_dir={tmp_path / 'run'}",
        monkeypatch,
    )
    assert "lerobot-wm encode" in message


def test_policy_without_a_world_model(
    latents_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = refused(
        f"--policy.type=wm_bc --dataset.repo_id=test/latents --dataset.root={latents_root} "
        f"--output_dir={tmp_path / 'run'}",
        monkeypatch,
    )
    assert "--policy.world_model_path" in message


@pytest.fixture(scope="module", params=POLICY_TYPES)
def oracle(
    request: pytest.FixtureRequest,
    demos_root: Path,
    tmp_path_factory: pytest.TempPathFactory,
    lerobot_wm_command: Callable[..., None],
) -> LatentPolicy:
    """A policy on the full state in place of the latent, trained for a few steps."""
    run_folder = tmp_path_factory.mktemp("oracle") / "run"
    lerobot_wm_command(
        f"train --policy.type={request.param} --policy.use_latent=false --policy.use_environment_state=true",
        f"--steps=5 --batch_size=8 {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)}",
        f"--output_dir={run_folder}",
    )
    checkpoint = run_folder / "checkpoints" / "last" / "pretrained_model"
    return get_policy_class(request.param).from_pretrained(checkpoint)


def test_state_oracle_acts_on_the_full_state(oracle: LatentPolicy, demos: LeRobotDataset) -> None:
    assert set(oracle.config.input_features) == {"observation.state", "observation.environment_state"}
    env_state = demos[0]["observation.environment_state"][None]  # (1, 39)
    seen = frame(demos, 0)
    action = oracle.select_action({**seen, "observation.environment_state": env_state})
    moved = env_state + torch.eye(39)[37] * 0.1  # the goal, 10 cm away
    assert not torch.equal(action, oracle.select_action({**seen, "observation.environment_state": moved}))
    with pytest.raises(ValueError, match=r"--env\.environment_state=true"):
        oracle.select_action(seen)


def test_state_oracle_is_scaled_by_the_dataset(oracle: LatentPolicy, demos: LeRobotDataset) -> None:
    states = torch.stack(list(demos.hf_dataset["observation.environment_state"]))  # (N, 39)
    batch = {
        "observation.state": states[:, :4],
        "observation.environment_state": states,
    }
    scaled = oracle.observation_at(batch, torch.zeros(len(states), 2))[:, -39:]
    varies = states.std(0) > 1e-4
    torch.testing.assert_close(scaled.mean(0), torch.zeros(39), atol=1e-2, rtol=0)
    torch.testing.assert_close(scaled.std(0)[varies], torch.ones(int(varies.sum())), atol=1e-2, rtol=0)


def test_windows_are_read_as_frames_are(oracle: LatentPolicy, demos: LeRobotDataset) -> None:
    keys = ("observation.state", "observation.environment_state")
    tasks = torch.eye(2)[[0]]
    window = {key: torch.stack([demos[0][key], demos[1][key]])[None] for key in keys}  # (1, 2, ·)
    for t in (0, 1):
        single = {key: demos[t][key][None] for key in keys}
        assert torch.equal(oracle.observation_at(window, tasks, t), oracle.observation_at(single, tasks))


def test_state_oracle_without_the_full_state_in_the_dataset(oracle: LatentPolicy) -> None:
    config = deepcopy(oracle.config)
    del config.input_features["observation.environment_state"]
    with pytest.raises(ValueError, match=r"dataset has no 'observation\.environment_state'"):
        config.validate_features()


def test_cameras_that_a_policy_does_not_read_are_not_decoded(
    demos_root: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    """Half of the blind control's training time went into images that it never looked at."""
    demos = tmp_path / "demos"
    shutil.copytree(demos_root, demos)
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.use_latent=false --steps=2 --batch_size=4 {TRAIN_FLAGS}",
        f"{DATASET_FLAGS.format(root=demos)} --output_dir={tmp_path / 'run'}",
    )
    assert not list(tmp_path.rglob("*.npy"))


def test_a_dataset_that_is_still_to_be_downloaded_is_encoded_once(
    demos_root: Path, world_model_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "demos"
    shutil.copytree(demos_root / "meta", root / "meta")  # all that LeRobotDatasetMetadata downloads

    def download(*args: Any, **kwargs: Any) -> LeRobotDataset:
        for folder in ("data", "videos"):
            shutil.copytree(demos_root / folder, root / folder, dirs_exist_ok=True)
        return LeRobotDataset(*args, **kwargs)

    monkeypatch.setattr("lerobot_wm.encode.dataset.LeRobotDataset", download)
    meta = LeRobotDatasetMetadata("test/demos", root=root)
    first = encode_to_cache(str(world_model_path), "test/demos", meta, "cpu")
    assert encode_to_cache(str(world_model_path), "test/demos", meta, "cpu") == first


def test_a_training_whose_latents_were_removed_says_how_to_make_them_again(
    demos_root: Path,
    world_model_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lerobot_wm_command: Callable[..., None],
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    run = tmp_path / "run"
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={world_model_path} --steps=2 --save_freq=1",
        f"--batch_size=4 {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)} --output_dir={run}",
    )
    [latents] = (tmp_path / "cache").glob("*/latents-*")
    shutil.rmtree(latents)
    checkpoint = run / "checkpoints" / "000001" / "pretrained_model"
    shutil.rmtree(run / "checkpoints" / "000002")
    go_on = f"train --config_path={checkpoint / 'train_config.json'} --resume=true"
    with pytest.raises(FileNotFoundError, match="lerobot-wm encode") as error:
        lerobot_wm_command(go_on)
    flags = re.search(r"lerobot-wm (encode .*)", str(error.value))[1]
    flags = flags.replace("repo_id=...", "repo_id=test/demos").replace("root=...", f"root={demos_root}")
    lerobot_wm_command(f"{flags} --device=cpu")
    lerobot_wm_command(go_on)
    assert (run / "checkpoints" / "000002").is_dir()


@pytest.mark.parametrize("policy_type", POLICY_TYPES)
def test_a_policy_left_in_training_mode_acts_without_dropout(
    policy_type: str, policy_paths: dict[str, Path], demos: LeRobotDataset
) -> None:
    policy = load(policy_paths, policy_type)
    actions = []
    for mode in (False, True):
        policy.train(mode)
        policy.reset()
        actions.append(policy.select_action(frame(demos, 0)))
    assert torch.equal(*actions)


@pytest.mark.parametrize(
    "wrong",
    [{"expectile": 1.7}, {"discount": 5.0}, {"target_rate": 0.0}, {"beta": -3.0}, {"sweep_betas": [-1.0]}],
)
def test_settings_that_invert_a_loss_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        IQLConfig(**wrong)

"""Training that goes on from a checkpoint, with another dataset: other tasks, other camera sizes, no reward."""

import json
import shutil
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.io_utils import load_stats, write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import PreTrainedPolicy, make_policy
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file
from torch import nn
from torch._subclasses.fake_tensor import DynamicOutputShapeException, FakeTensorMode

from lerobot_wm.encode.dataset import encode_to_cache
from lerobot_wm.nn.mlp import MLP
from lerobot_wm.policies.common.acting_policy import ActingPolicy
from lerobot_wm.policies.common.checkpoint import CheckpointError
from lerobot_wm.policies.common.iql import IQLConfig
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from tests.flags import SMALL_WORLD_MODEL, TRAIN_FLAGS
from tests.recording import FRONT, WRIST, camera, record, train_flags, vector

Command = Callable[..., None]
CHECKPOINT = Path("checkpoints", "last", "pretrained_model")
ACTING = ("wm_bc", "wm_iql", "e2e_bc", "e2e_iql")
SHORT = "--steps=1 --batch_size=4 --log_freq=1"


def features(front: tuple[int, int] = (48, 64), state: int = 5, action: int = 3) -> dict[str, dict[str, Any]]:
    return {
        FRONT: camera(*front),
        WRIST: camera(32, 32),
        "observation.state": vector(state),
        "action": vector(action),
    }


REWARDS = {"next.reward": vector(1), "next.done": vector(1, "bool")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fine_tuning")


@pytest.fixture(scope="module")
def known(folder: Path) -> LeRobotDataset:
    """What the checkpoints are trained on."""
    return record(folder / "known", {**features(), **REWARDS}, [("Reach", 6), ("Push", 8)])


@pytest.fixture(scope="module")
def other(folder: Path) -> LeRobotDataset:
    """One task of before and a new one, the first camera of another size, other ranges of numbers."""
    return record(folder / "other", {**features((60, 40)), **REWARDS}, [("Wave", 5), ("Push", 9)])


@pytest.fixture(scope="module")
def encoded(
    folder: Path, known: LeRobotDataset, other: LeRobotDataset, lerobot_wm_command: Command
) -> tuple[Path, Callable[[LeRobotDataset], LeRobotDataset]]:
    """A world model that has seen the known dataset's cameras, and what encodes a dataset with it, once."""
    lerobot_wm_command(
        f"init --policy.type=wm_rssm {SMALL_WORLD_MODEL} --policy.window_length=4 --policy.device=cpu",
        f"--dataset.repo_id=test/recorded --dataset.root={known.root} --output_dir={folder / 'wm_rssm'}",
    )
    path = folder / "wm_rssm" / "pretrained_model"

    def encode(dataset: LeRobotDataset) -> LeRobotDataset:
        meta = LeRobotDatasetMetadata("test/recorded", root=dataset.root)
        return LeRobotDataset("test/latents", root=encode_to_cache(str(path), "test/recorded", meta, "cpu"))

    return path, encode


@pytest.fixture(scope="module")
def checkpoints(
    folder: Path, known: LeRobotDataset, encoded: tuple, lerobot_wm_command: Command
) -> dict[str, Path]:
    """A checkpoint of every type that is trained."""
    world_model_path, encode = encoded
    paths = {"wm_rssm": world_model_path}
    for policy_type in ACTING:
        on_latents = policy_type.startswith("wm")
        options = f"--policy.world_model_path={world_model_path}" if on_latents else ""
        dataset = encode(known) if on_latents else known
        lerobot_wm_command(
            f"init --policy.type={policy_type} --policy.device=cpu {options} --output_dir={folder / policy_type}",
            f"--dataset.repo_id={dataset.repo_id} --dataset.root={dataset.root}",
        )
        paths[policy_type] = folder / policy_type / "pretrained_model"
    return paths


def load(path: Path) -> PreTrainedPolicy:
    return get_policy_class(PreTrainedConfig.from_pretrained(path).type).from_pretrained(path)


def go_on(path: Path, dataset: LeRobotDataset) -> PreTrainedPolicy:
    """The policy that LeRobot's training commands train with `--policy.path`."""
    config = PreTrainedConfig.from_pretrained(path)
    config.pretrained_path = path
    return make_policy(config, ds_meta=dataset.meta)


def act(policy: PreTrainedPolicy, dataset: LeRobotDataset, task: str) -> torch.Tensor:
    """Two steps of an episode."""
    policy.reset()
    actions = []
    for index in (0, 1):
        batch = {key: dataset[index][key][None] for key in (FRONT, WRIST, "observation.state")}
        actions.append(policy.select_action({**batch, "task": [task]}))
    return torch.cat(actions)


@pytest.mark.parametrize("policy_type", ACTING)
def test_new_tasks_come_after_the_known_ones(
    policy_type: str, checkpoints: dict[str, Path], encoded: tuple, other: LeRobotDataset, tmp_path: Path
) -> None:
    """Known tasks are acted on as before, until training changes that."""
    dataset = encoded[1](other) if policy_type.startswith("wm") else other
    before, after = load(checkpoints[policy_type]), go_on(checkpoints[policy_type], dataset)
    assert isinstance(after, ActingPolicy)
    assert before.config.tasks == ["Reach", "Push"]
    assert after.config.tasks == ["Reach", "Push", "Wave"]
    for scaling in ("state_scaling", "action_scaling"):
        for name in ("offset", "scale"):
            assert torch.equal(*(getattr(getattr(p, scaling), name) for p in (before, after)))
    # It is made for the new dataset's camera now; have the old one take its frames too.
    assert after.config.input_features[FRONT].shape == (3, 60, 40)
    assert after.config.image_size == before.config.image_size
    before.config.input_features = after.config.input_features
    for task in ("Reach", "Push"):
        torch.testing.assert_close(act(after, other, task), act(before, other, task), atol=1e-6, rtol=1e-6)
    place = after.task_start + 2
    for old, new in zip(before.observation_networks(), after.observation_networks(), strict=True):
        first = [
            next(layer for layer in head.modules() if isinstance(layer, nn.Linear)) for head in (old, new)
        ]
        assert first[1].in_features == first[0].in_features + 1 == first[1].weight.shape[1]
        assert first[1].weight.requires_grad == first[0].weight.requires_grad
        assert not first[1].weight[:, place].any()
    after.save_pretrained(tmp_path)
    assert torch.equal(act(load(tmp_path), other, "Wave"), act(after, other, "Wave"))


def test_a_fine_tuned_run_is_resumed_exactly(
    checkpoints: dict[str, Path], other: LeRobotDataset, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    run = tmp_path / "e2e_bc"
    lerobot_wm_command(
        f"train --policy.path={checkpoints['e2e_bc']} --steps=2 --save_freq=1 --batch_size=4 --log_freq=1",
        f"{train_flags(other)} --output_dir={run}",
    )
    whole = load_file(run / CHECKPOINT / "model.safetensors")
    shutil.rmtree(run / "checkpoints" / "000002")
    config = run / "checkpoints" / "000001" / "pretrained_model" / "train_config.json"
    lerobot_wm_command(f"train --config_path={config} --resume=true --output_dir={run}")
    resumed = load_file(run / "checkpoints" / "000002" / "pretrained_model" / "model.safetensors")
    assert whole.keys() == resumed.keys()
    assert not [name for name, tensor in whole.items() if not torch.equal(tensor, resumed[name])]


@pytest.mark.parametrize("policy_type", ["wm_rssm", "wm_bc", "e2e_iql"])
def test_plain_lerobot_train(
    policy_type: str,
    checkpoints: dict[str, Path],
    other: LeRobotDataset,
    tmp_path: Path,
    lerobot_wm_command: Command,
    lerobot_train_command: Command,
) -> None:
    data = train_flags(other)
    if policy_type == "wm_bc":  # its checkpoint has the world model that makes its latents
        lerobot_wm_command(
            f"encode --world_model_path={checkpoints['wm_bc']} --device=cpu --dataset.repo_id=test/recorded",
            f"--dataset.root={other.root} --output_repo_id=test/latents --output_root={tmp_path / 'latents'}",
        )
        data = f"{TRAIN_FLAGS} --dataset.repo_id=test/latents --dataset.root={tmp_path / 'latents'}"
    run = tmp_path / policy_type
    flags = f"--policy.path={checkpoints[policy_type]} {SHORT} {data} --output_dir={run}"
    lerobot_train_command(flags)
    policy = load(run / CHECKPOINT)
    assert policy.config.input_features[FRONT].shape == (3, 60, 40)
    if policy_type != "wm_rssm":
        assert policy.config.tasks == ["Reach", "Push", "Wave"]
        assert not torch.equal(act(policy, other, "Wave"), act(policy, other, "Push"))


def test_our_command_encodes_with_the_checkpoints_own_world_model(
    checkpoints: dict[str, Path], other: LeRobotDataset, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    copy = tmp_path / "published"
    shutil.copytree(checkpoints["wm_iql"], copy)
    config = copy / "config.json"
    config.write_text(config.read_text().replace(str(checkpoints["wm_rssm"]), "gone"))
    lerobot_wm_command(
        f"train --policy.path={copy} {SHORT} {train_flags(other)} --output_dir={tmp_path / 'run'}"
    )
    policy = load(tmp_path / "run" / CHECKPOINT)
    assert policy.config.tasks == ["Reach", "Push", "Wave"]
    assert act(policy, other, "Wave").shape == (2, 3)


def test_a_world_model_of_other_cameras_under_a_new_policy(
    encoded: tuple, other: LeRobotDataset, checkpoints: dict[str, Path]
) -> None:
    """The policy is for the cameras that its latents were made from."""
    config = make_policy_config("wm_bc", world_model_path=str(checkpoints["wm_rssm"]), device="cpu")
    policy = make_policy(config, ds_meta=encoded[1](other).meta).eval()
    assert act(policy, other, "Wave").shape == (2, 3)


def test_a_world_model_goes_on_without_rewards(
    checkpoints: dict[str, Path], folder: Path, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    """Its reward head stays as it was, and the rest is trained."""
    dataset = record(tmp_path / "dataset", features(), [("Wave", 6)])
    lerobot_wm_command(
        f"train --policy.path={checkpoints['wm_rssm']} {SHORT} {train_flags(dataset)} --output_dir={tmp_path / 'run'}"
    )
    before, after = (
        load_file(path / "model.safetensors")
        for path in (checkpoints["wm_rssm"], tmp_path / "run" / CHECKPOINT)
    )
    assert before.keys() == after.keys()
    changed = {name for name, tensor in before.items() if not torch.equal(tensor, after[name])}
    assert not [name for name in changed if "reward_head" in name or "scaling" in name]
    assert "world_model.encoder.layers.0.weight" in changed
    assert WMRSSMPolicy.from_pretrained(tmp_path / "run" / CHECKPOINT).config.rssm.predict_reward


@pytest.mark.parametrize(
    ("policy_type", "key", "size"),
    [
        ("wm_rssm", "action", 7),
        ("wm_bc", "action", 7),
        ("wm_bc", "state", 9),
        ("e2e_bc", "action", 7),
        ("e2e_iql", "state", 9),
    ],
)
def test_other_sizes_are_refused(
    policy_type: str, key: str, size: int, checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    dataset = record(tmp_path / "dataset", {**features(**{key: size}), **REWARDS}, [("Reach", 2)])
    with pytest.raises(ValueError, match=rf"{policy_type} was trained with '.*{key}' of size [35].* {size}"):
        go_on(checkpoints[policy_type], dataset)


def test_a_state_that_a_world_model_does_not_read_may_have_any_size(
    checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    dataset = record(tmp_path / "dataset", features(state=9), [("Reach", 4)])
    assert isinstance(go_on(checkpoints["wm_rssm"], dataset), WMRSSMPolicy)


def test_inserted_inputs_change_nothing() -> None:
    torch.manual_seed(0)
    mlp, x = MLP(5, [8, 8], 2), torch.randn(4, 5)
    before = mlp(x)
    mlp.insert_inputs(3, 2)
    wider = torch.cat([x[:, :3], torch.randn(4, 2), x[:, 3:]], dim=1)
    torch.testing.assert_close(mlp(wider), before)
    mlp(wider).sum().backward()
    assert mlp.trunk[0].weight.grad[:, 3:5].any()


def test_what_a_checkpoint_holds_cannot_be_changed(
    checkpoints: dict[str, Path], encoded: tuple, known: LeRobotDataset
) -> None:
    """Its world model stays, and no actor is added."""
    dataset = encoded[1](known)
    for policy_type, change, message in (
        ("wm_bc", {"world_model_path": "another"}, "world_model_path=another: "),
        ("wm_iql", {"iql": IQLConfig(sweep_betas=[3.0], trained_betas=[0.5])}, "beta 3; .* 0.5"),
    ):
        config = PreTrainedConfig.from_pretrained(checkpoints[policy_type])
        config.pretrained_path = checkpoints[policy_type]
        for name, value in change.items():
            setattr(config, name, value)
        with pytest.raises(ValueError, match=message):
            make_policy(config, ds_meta=dataset.meta)


def test_a_new_training_with_the_settings_of_a_finished_one(
    encoded: tuple,
    known: LeRobotDataset,
    other: LeRobotDataset,
    tmp_path: Path,
    lerobot_wm_command: Command,
) -> None:
    """They name the world model, whose weights are its checkpoint's; tasks and actors are the new one's own."""
    path, encode = encoded
    first = f"--policy.type=wm_iql --policy.world_model_path={path} {train_flags(known)}"
    lerobot_wm_command(f"train {first} {SHORT} --output_dir={tmp_path / 'first'}")
    settings = tmp_path / "first" / CHECKPOINT / "train_config.json"
    latents = encode(other)
    lerobot_wm_command(
        f"train --config_path={settings} --seed=1 --policy.iql.sweep_betas=[3] --dataset.root={latents.root}",
        f"--output_dir={tmp_path / 'second'}",
    )
    second = load(tmp_path / "second" / CHECKPOINT)
    assert second.config.tasks == ["Wave", "Push"]
    assert second.config.iql.trained_betas == [0.5, 3]
    theirs = load_file(path / "model.safetensors")
    for name, tensor in second.world_model.state_dict().items():
        assert torch.equal(tensor, theirs[f"world_model.{name}"]), name


@pytest.mark.parametrize("policy_type", ["wm_rssm", "e2e_bc"])
def test_a_checkpoint_keeps_its_cameras(
    policy_type: str, checkpoints: dict[str, Path], known: LeRobotDataset
) -> None:
    """In another order they would be shown to each other's filters."""
    path = checkpoints[policy_type]
    with pytest.raises(ValueError, match=rf"image_key={WRIST},{FRONT}: .* {FRONT},{WRIST}"):
        make_policy(changed(path, image_key=f"{WRIST},{FRONT}"), ds_meta=known.meta)
    same = make_policy(changed(path, image_key=f"{FRONT}, {WRIST}"), ds_meta=known.meta)
    assert same.config.cameras == [FRONT, WRIST]


def test_cameras_that_were_not_chosen_need_not_be_there_again(
    known: LeRobotDataset, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    lerobot_wm_command(
        f"init --policy.type=wm_rssm {SMALL_WORLD_MODEL} --policy.device=cpu --policy.image_key={FRONT}",
        f"--dataset.repo_id=test/recorded --dataset.root={known.root} --output_dir={tmp_path / 'wm'}",
    )
    front = {key: feature for key, feature in features().items() if key != WRIST}
    dataset = record(
        tmp_path / "dataset", {**front, "observation.images.side": camera(32, 32)}, [("Wave", 30)]
    )
    policy = go_on(tmp_path / "wm" / "pretrained_model", dataset)
    assert [key for key in policy.config.input_features if "image" in key] == [FRONT]


def changed(path: Path, **settings: Any) -> PreTrainedConfig:
    """The configuration of a checkpoint to go on from, with settings of `--policy.path`'s flags."""
    flags = [f"--{name.replace('__', '.')}={str(value).lower()}" for name, value in settings.items()]
    config = PreTrainedConfig.from_pretrained(path, cli_overrides=flags)
    config.pretrained_path = path
    return config


@pytest.mark.parametrize(
    ("policy_type", "settings"),
    [
        ("wm_rssm", {"rssm__use_proprio": True}),
        ("wm_rssm", {"rssm__predict_reward": False, "rssm__action_scale": 0.1, "rssm__deter_dim": 32}),
        ("wm_bc", {"use_latent": False}),
        ("wm_iql", {"hidden_dims": [64]}),
        ("e2e_bc", {"encoder": "resnet18"}),
    ],
)
def test_settings_that_make_other_networks_are_refused(
    policy_type: str,
    settings: dict[str, Any],
    checkpoints: dict[str, Path],
    known: LeRobotDataset,
    encoded: tuple,
) -> None:
    path = checkpoints[policy_type]
    dataset = encoded[1](known) if policy_type.startswith("wm_b") else known
    with pytest.raises(CheckpointError, match=r"model\.safetensors"):
        make_policy(changed(path, **settings, push_to_hub=False, use_amp=True), ds_meta=dataset.meta)


def test_weights_may_be_left_out_where_loading_is_not_strict(checkpoints: dict[str, Path]) -> None:
    path = checkpoints["wm_rssm"]
    policy = WMRSSMPolicy.from_pretrained(path, config=changed(path, rssm__use_proprio=True), strict=False)
    assert policy.world_model.config.use_proprio


@pytest.mark.parametrize(
    ("policy_type", "settings"),
    [
        (
            "wm_rssm",
            {"rssm__kl_scale": 0.3, "rssm__free_nats": 0.5, "rssm__image_shift": 2, "window_length": 3},
        ),
        ("e2e_iql", {"lr": 0.1, "dropout": 0.5, "iql__expectile": 0.9, "random_crop_pad": 4}),
    ],
)
def test_other_settings_may_be_changed(
    policy_type: str, settings: dict[str, Any], checkpoints: dict[str, Path], known: LeRobotDataset
) -> None:
    torch.manual_seed(0)
    unchanged, drawn = go_on(checkpoints[policy_type], known), torch.randn(3)
    torch.manual_seed(0)
    policy = make_policy(changed(checkpoints[policy_type], **settings), ds_meta=known.meta)
    assert torch.equal(torch.randn(3), drawn), "a seeded training would draw other numbers"
    for name, tensor in unchanged.state_dict().items():
        assert torch.equal(policy.state_dict()[name], tensor)
    for name, value in settings.items():
        *path, last = name.split("__")
        assert getattr(reduce(getattr, path, policy.config), last) == value


def test_a_world_model_of_scaled_images_goes_on_with_renamed_cameras(
    folder: Path, known: LeRobotDataset, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    """The statistics that scale are the checkpoint's: the dataset's have other names."""
    lerobot_wm_command(
        f"init --policy.type=wm_rssm {SMALL_WORLD_MODEL} --policy.window_length=4 --policy.device=cpu",
        f"--policy.rssm.standardize_images=true --dataset.repo_id=test/recorded --dataset.root={known.root}",
        f"--output_dir={tmp_path / 'scaled'}",
    )
    names = {FRONT: "observation.images.a", WRIST: "observation.images.b"}
    renamed = {names.get(key, key): feature for key, feature in {**features(), **REWARDS}.items()}
    dataset = record(tmp_path / "dataset", renamed, [("Wave", 6)])
    rename_map = json.dumps({new: old for old, new in names.items()})
    lerobot_wm_command(
        f"train --policy.path={tmp_path / 'scaled' / 'pretrained_model'} {SHORT} {train_flags(dataset)}",
        f"--rename_map={rename_map.replace(' ', '')} --output_dir={tmp_path / 'run'}",
    )
    before, after = (
        load_file(path / "model.safetensors")["world_model.image_scaling.offset"]
        for path in (tmp_path / "scaled" / "pretrained_model", tmp_path / "run" / CHECKPOINT)
    )
    assert torch.equal(before, after)


def test_iql_goes_on_with_a_renamed_state(
    checkpoints: dict[str, Path], tmp_path: Path, lerobot_wm_command: Command
) -> None:
    renamed = {("observation.joints" if k == "observation.state" else k): v for k, v in features().items()}
    dataset = record(tmp_path / "dataset", {**renamed, **REWARDS}, [("Wave", 6)])
    lerobot_wm_command(
        f"train --policy.path={checkpoints['e2e_iql']} {SHORT} {train_flags(dataset)}",
        f'--rename_map={{"observation.joints":"observation.state"}} --output_dir={tmp_path / "run"}',
    )
    assert load(tmp_path / "run" / CHECKPOINT).config.tasks == ["Reach", "Push", "Wave"]


def test_actions_that_it_cannot_command_are_told(
    known: LeRobotDataset, checkpoints: dict[str, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = tmp_path / "wider"
    shutil.copytree(known.root, root)
    stats = load_stats(root)
    stats["action"]["max"][1] = 7
    write_stats(stats, root)
    for dataset, said in (
        (known, []),
        (LeRobotDataset("test/wider", root=root), ["Number 1 of the actions"]),
    ):
        caplog.clear()
        go_on(checkpoints["e2e_bc"], dataset)
        told = [record.message for record in caplog.records if "cannot command" in record.message]
        assert [message[: len("Number 1 of the actions")] for message in told] == said
    assert "to 7 in test/wider" in told[0]


def test_actions_are_compared_where_the_statistics_are(
    known: LeRobotDataset, checkpoints: dict[str, Path]
) -> None:
    """The policy may be on a GPU. Tensors that only know their device and shape tell without one."""
    policy = load(checkpoints["e2e_bc"])
    with FakeTensorMode(allow_non_fake_inputs=True):
        for name, values in list(policy.action_scaling.named_buffers()):
            setattr(policy.action_scaling, name, torch.empty(values.shape, device="cuda"))
        with pytest.raises(DynamicOutputShapeException):  # where the numbers would decide
            policy.warn_if_actions_out_of_range(known.meta)


def test_a_new_training_with_the_settings_of_a_finished_one_sees_its_own_cameras(
    known: LeRobotDataset, checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    larger = record(tmp_path / "larger", {**features(), **REWARDS, FRONT: camera(40, 52)}, [("Push", 6)])
    config = PreTrainedConfig.from_pretrained(checkpoints["e2e_bc"])
    size = config.encoder_image_size
    policy = make_policy(config, ds_meta=larger.meta)
    assert policy.config.input_features[FRONT].shape == (3, 40, 52)
    assert policy.config.encoder_image_size == size


def test_a_revision_of_the_checkpoint_before_is_not_handed_on(
    checkpoints: dict[str, Path], tmp_path: Path
) -> None:
    """LeRobot would ask the new policy's repository for it."""
    policy = load(checkpoints["wm_bc"])
    policy.config.pretrained_revision = "v1"
    policy.save_pretrained(tmp_path)
    assert policy.config.pretrained_revision == "v1"
    assert load(tmp_path).config.pretrained_revision is None


RENAMED = {
    FRONT: "observation.images.a",
    WRIST: "observation.images.b",
    "observation.state": "observation.joints",
}
SWAPPED = {FRONT: WRIST, WRIST: FRONT}


def record_renamed(root: Path, names: dict[str, str]) -> tuple[LeRobotDataset, str]:
    """The other dataset under other names, and the flag that gives its features the checkpoints' names."""
    named = {names.get(key, key): feature for key, feature in {**features((60, 40)), **REWARDS}.items()}
    dataset = record(root, named, [("Wave", 5), ("Push", 9)])
    return dataset, f"--rename_map={json.dumps({new: old for old, new in names.items()}).replace(' ', '')}"


@pytest.mark.parametrize("names", [RENAMED, SWAPPED], ids=["renamed", "swapped"])
@pytest.mark.parametrize("policy_type", ["wm_rssm", "wm_bc", "e2e_iql"])
def test_renamed_cameras_may_have_another_size(
    policy_type: str,
    names: dict[str, str],
    checkpoints: dict[str, Path],
    tmp_path: Path,
    lerobot_wm_command: Command,
) -> None:
    dataset, rename_map = record_renamed(tmp_path / "dataset", names)
    run = tmp_path / "run"
    lerobot_wm_command(
        f"train --policy.path={checkpoints[policy_type]} {SHORT} {train_flags(dataset)} {rename_map}",
        f"--save_freq=1 --output_dir={run}",
    )
    config = load(run / CHECKPOINT).config
    assert config.input_features[FRONT].shape == (3, 60, 40)
    assert config.input_features[WRIST].shape == (3, 32, 32)
    settings = run / CHECKPOINT / "train_config.json"
    lerobot_wm_command(f"train --config_path={settings} --resume=true --steps=2 --output_dir={run}")
    assert load(run / CHECKPOINT).config.input_features == config.input_features


def test_plain_lerobot_train_knows_the_size_of_renamed_cameras_that_are_alike(
    checkpoints: dict[str, Path], tmp_path: Path, lerobot_train_command: Command
) -> None:
    """LeRobot tells a policy of no map."""
    names = {"observation.images.a": FRONT, "observation.images.b": WRIST}
    renamed = {**features(), **REWARDS, **{name: camera(60, 40) for name in names}}
    del renamed[FRONT], renamed[WRIST]
    dataset = record(tmp_path / "dataset", renamed, [("Wave", 5)])
    lerobot_train_command(
        f"--policy.path={checkpoints['e2e_bc']} {SHORT} {train_flags(dataset)} --output_dir={tmp_path / 'run'} "
        f"--rename_map={json.dumps(names).replace(' ', '')}"
    )
    shapes = load(tmp_path / "run" / CHECKPOINT).config.input_features
    assert shapes[FRONT].shape == shapes[WRIST].shape == (3, 60, 40)


def test_renamed_features_are_encoded_as_what_they_are_called_then(
    encoded: tuple, other: LeRobotDataset, tmp_path: Path, lerobot_wm_command: Command
) -> None:
    dataset, rename_map = record_renamed(tmp_path / "dataset", RENAMED)
    flags = f"encode --world_model_path={encoded[0]} --device=cpu --dataset.repo_id=test/recorded"
    out = f"--output_repo_id=test/latents --output_root={tmp_path / 'latents'}"
    lerobot_wm_command(flags, f"--dataset.root={dataset.root} {rename_map}", out)
    latents, expected = LeRobotDataset("test/latents", root=tmp_path / "latents"), encoded[1](other)
    for row, same in zip(latents, expected, strict=True):
        assert torch.equal(row["observation.latent"], same["observation.latent"])
        assert torch.equal(row["observation.joints"], same["observation.state"])


def test_a_renamed_state_of_another_size_is_refused(
    checkpoints: dict[str, Path], tmp_path: Path, lerobot_wm_command: Command
) -> None:
    """Before its images are encoded."""
    renamed = {
        ("observation.joints" if k == "observation.state" else k): v for k, v in features(state=9).items()
    }
    dataset = record(tmp_path / "dataset", renamed, [("Wave", 6)])
    with pytest.raises(ValueError, match=r"wm_bc was trained with 'observation.state' of size 5.* 9"):
        lerobot_wm_command(
            f"train --policy.path={checkpoints['wm_bc']} {SHORT} {train_flags(dataset)}",
            f'--rename_map={{"observation.joints":"observation.state"}} --output_dir={tmp_path / "run"}',
        )
    assert not (tmp_path / "dataset.cache").exists()


@pytest.mark.skipif(
    hasattr(lerobot_train, "_preprocess_dataset_batch"),
    reason="LeRobot after 0.6.1 applies --rename_map twice, which moves a name that is both old and new",
)
def test_a_state_that_is_given_its_name_is_the_one_that_counts(
    checkpoints: dict[str, Path], tmp_path: Path, lerobot_wm_command: Command
) -> None:
    """The dataset has another one by that name, of another size, which gets another name itself."""
    states = {"observation.state": vector(9), "observation.arm": vector(5)}
    dataset = record(tmp_path / "dataset", {**features(), **states}, [("Wave", 6)])
    names = {"observation.arm": "observation.state", "observation.state": "observation.all"}
    lerobot_wm_command(
        f"train --policy.path={checkpoints['wm_bc']} {SHORT} {train_flags(dataset)}",
        f"--rename_map={json.dumps(names).replace(' ', '')} --output_dir={tmp_path / 'run'}",
    )
    assert load(tmp_path / "run" / CHECKPOINT).config.input_features["observation.state"].shape == (5,)

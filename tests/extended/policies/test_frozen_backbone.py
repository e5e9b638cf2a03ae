"""A frozen image backbone in place of the world model, through the commands a user gives."""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import torchvision
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_policy
from lerobot.policies.factory import get_policy_class, make_policy_config
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_wm.data.latents import LatentRecord
from lerobot_wm.encode.dataset import encode_to_cache
from lerobot_wm.policies.frozen_backbone.configuration_frozen_backbone import FrozenBackboneConfig
from lerobot_wm.policies.frozen_backbone.modeling_frozen_backbone import (
    FrozenBackbone,
    FrozenBackbonePolicy,
    load_backbone_weights,
)
from lerobot_wm.policies.latent.policy import encoder_fingerprint, load_encoder
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS
from tests.recording import FRONT, WRIST, camera, record, vector

RESNET = "--policy.backbone=resnet18 --policy.backbone_image_size=32"
FEATURES = 512


@pytest.fixture(scope="module")
def backbone_path(
    demos_root: Path, tmp_path_factory: pytest.TempPathFactory, lerobot_wm_command: Callable[..., None]
) -> Path:
    """A checkpoint of a randomly initialised backbone."""
    folder = tmp_path_factory.mktemp("backbone")
    lerobot_wm_command(
        f"init --policy.type=frozen_backbone {RESNET} --policy.device=cpu --seed=3",
        DATASET_FLAGS.format(root=demos_root),
        f"--output_dir={folder}",
    )
    return folder / "pretrained_model"


@pytest.fixture(scope="module")
def features_root(
    backbone_path: Path,
    demos_root: Path,
    tmp_path_factory: pytest.TempPathFactory,
    lerobot_wm_command: Callable[..., None],
) -> Path:
    """The demonstrations encoded by it."""
    root = tmp_path_factory.mktemp("features") / "dataset"
    lerobot_wm_command(
        f"encode --world_model_path={backbone_path} --device=cpu --output_repo_id=test/features",
        DATASET_FLAGS.format(root=demos_root),
        f"--output_root={root}",
    )
    return root


@pytest.fixture(scope="module")
def policy_path(
    features_root: Path,
    backbone_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    lerobot_wm_command: Callable[..., None],
) -> Path:
    """A wm_bc checkpoint trained on the features for a few steps."""
    run_folder = tmp_path_factory.mktemp("frozen_bc") / "run"
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={backbone_path} --steps=4 --batch_size=16",
        TRAIN_FLAGS,
        f"--dataset.repo_id=test/features --dataset.root={features_root} --output_dir={run_folder}",
    )
    return run_folder / "checkpoints" / "last" / "pretrained_model"


def test_the_policy_sees_in_the_environment_what_it_was_trained_on(
    demos: LeRobotDataset, features_root: Path, policy_path: Path
) -> None:
    policy = get_policy_class("wm_bc").from_pretrained(policy_path)
    rows = LeRobotDataset("test/features", root=features_root).hf_dataset[90:94]
    stored = torch.stack(list(rows["observation.latent"]))  # (4, F)
    assert stored.shape == (4, FEATURES)
    for index, features in zip(range(90, 94), stored, strict=True):
        item = demos[index]
        batch = {key: item[key][None] for key in ("observation.image", "observation.state")}
        policy.select_action({**batch, "task": [item["task"]]})
        torch.testing.assert_close(policy._filter_state.latent[0], features, atol=1e-4, rtol=1e-4)
    record = LatentRecord.read(features_root)
    assert record.world_model_fingerprint == policy.config.world_model_fingerprint


def test_features_are_scaled_by_the_statistics_of_the_dataset(features_root: Path, policy_path: Path) -> None:
    policy = get_policy_class("wm_bc").from_pretrained(policy_path)
    dataset = LeRobotDataset("test/features", root=features_root)
    latents = torch.stack(list(dataset.hf_dataset["observation.latent"]))  # (N, F)
    zeros = torch.zeros(len(latents), 4), torch.zeros(len(latents), 2)
    scaled = policy.observation(*zeros, latents)[:, :FEATURES]
    torch.testing.assert_close(scaled.mean(0), torch.zeros(FEATURES), atol=1e-2, rtol=0)
    varies = latents.std(0) > 1e-5  # some of a random network's rectified features are always zero
    assert varies.sum() > 400
    torch.testing.assert_close(scaled.std(0), varies.float(), atol=1e-2, rtol=0)


def test_features_without_signal_are_refused(features_root: Path, policy_path: Path) -> None:
    """A MobileNet with random weights gives features of 1e-10: a policy on them would be blind, unnoticed."""
    config = PreTrainedConfig.from_pretrained(policy_path)
    meta = LeRobotDatasetMetadata("test/features", root=features_root)
    config.check_latents(meta)
    meta.stats["observation.latent"]["std"] *= 1e-8
    with pytest.raises(ValueError, match=r"latents of .* hardly vary.*weights_path"):
        config.check_latents(meta)


def test_checkpoint_is_self_contained(
    policy_path: Path, backbone_path: Path, demos: LeRobotDataset, tmp_path: Path
) -> None:
    copy = tmp_path / "elsewhere"
    shutil.copytree(policy_path, copy)
    config = copy / "config.json"
    config.write_text(config.read_text().replace(str(backbone_path), "gone"))
    policy = get_policy_class("wm_bc").from_pretrained(copy)
    policy.train()
    assert not policy.world_model.training  # or batch normalisation would follow the robot's images
    assert not any(parameter.requires_grad for parameter in policy.world_model.parameters())
    weights = load_file(backbone_path / "model.safetensors")
    for name, tensor in policy.world_model.state_dict().items():
        assert torch.equal(tensor, weights[f"world_model.{name}"]), name


def test_images_are_normalised_and_resized() -> None:
    torch.manual_seed(0)
    backbone = FrozenBackbone("resnet18", image_size=32)
    images = torch.rand(2, 3, 3, 32, 32)
    mean = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1)
    std = torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)
    expected = backbone.model(((images - mean) / std).flatten(0, 1)).unflatten(0, (2, 3))
    torch.testing.assert_close(backbone.embed(images), expected)
    plain = torch.rand(1, 1, 3, 1, 1)
    large, small = plain.expand(-1, -1, -1, 64, 48), plain.expand(-1, -1, -1, 32, 32)
    torch.testing.assert_close(backbone.embed(large), backbone.embed(small))


def init_weights(flags: str, folder: Path, command: Callable[..., None]) -> dict[str, Tensor]:
    command(f"init --policy.type=frozen_backbone --policy.device=cpu {flags} --output_dir={folder}")
    return load_file(folder / "pretrained_model" / "model.safetensors")


def test_seed_decides_the_random_weights(
    demos_root: Path, backbone_path: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    flags = f"{RESNET} {DATASET_FLAGS.format(root=demos_root)}"
    again = init_weights(f"{flags} --seed=3", tmp_path / "again", lerobot_wm_command)
    other = init_weights(f"{flags} --seed=4", tmp_path / "other", lerobot_wm_command)
    first = load_file(backbone_path / "model.safetensors")
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not torch.equal(first["world_model.model.conv1.weight"], other["world_model.model.conv1.weight"])


def resnet_weights() -> dict[str, Tensor]:
    torch.manual_seed(1)
    return torchvision.models.resnet18(weights=None).state_dict()


def r3m_file(path: Path) -> Path:
    """In the layout of R3M's published file: the ResNet without classifier beside a language model."""
    resnet = {f"module.convnet.{k}": v for k, v in resnet_weights().items() if not k.startswith("fc.")}
    torch.save({"r3m": {**resnet, "module.lang_enc.weight": torch.zeros(2)}, "global_step": 3}, path)
    return path


def torchvision_file(path: Path) -> Path:
    save_file(resnet_weights(), path)
    return path


@pytest.mark.parametrize(("make", "name"), [(r3m_file, "r3m.pt"), (torchvision_file, "r18.safetensors")])
def test_weights_of_a_users_file(
    make: Callable[[Path], Path],
    name: str,
    demos_root: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
) -> None:
    file = make(tmp_path / name)
    flags = f"--policy.weights_path={file} {DATASET_FLAGS.format(root=demos_root)}"
    loaded = init_weights(flags, tmp_path / "out", lerobot_wm_command)
    for key, tensor in resnet_weights().items():
        if not key.startswith("fc."):
            assert torch.equal(loaded[f"world_model.model.{key}"], tensor), key
    file.unlink()  # the checkpoint needs it no more
    load_encoder(str(tmp_path / "out" / "pretrained_model"))


def test_weights_that_do_not_fit(tmp_path: Path) -> None:
    model = FrozenBackbone("resnet18", 64).model
    weights = resnet_weights()
    short = {key: tensor for key, tensor in weights.items() if not key.startswith("layer4.1")}
    save_file(short, tmp_path / "short.safetensors")
    with pytest.raises(ValueError, match=r"missing 12 \(layer4\.1\.bn1\.bias.*left over none"):
        load_backbone_weights(model, str(tmp_path / "short.safetensors"))
    save_file({**weights, "conv1.weight": torch.zeros(64, 1, 7, 7)}, tmp_path / "grey.safetensors")
    with pytest.raises(ValueError, match=r"(?s)does not fit.*conv1\.weight"):
        load_backbone_weights(model, str(tmp_path / "grey.safetensors"))
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_backbone_weights(model, str(tmp_path / "gone.pt"))


def test_code_in_a_weights_file_is_not_run(tmp_path: Path) -> None:
    torch.save(nn.Linear(2, 2), tmp_path / "model.pt")
    with pytest.raises(ValueError, match=r"more than tensors.*state_dict"):
        load_backbone_weights(nn.Linear(2, 2), str(tmp_path / "model.pt"))


@pytest.mark.parametrize("name", ["mobilenet_v3_small", "regnet_y_400mf", "densenet121"])
def test_pooled_features_of_torchvisions_families(name: str) -> None:
    backbone = FrozenBackbone(name, 64)
    assert backbone.embed(torch.rand(2, 1, 3, 64, 64)).shape == (2, 1, backbone.latent_dim)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("resnet19", r"close are .*resnet18"),
        ("fasterrcnn_resnet50_fpn", "no classification model"),
        ("squeezenet1_1", "pools class scores"),
        ("vit_b_16", r"no images of 64x64.*--policy\.backbone_image_size"),
    ],
)
def test_models_that_cannot_serve(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrozenBackbone(name, 64)


def test_timm_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "timm", None)
    with pytest.raises(ImportError, match="pip install timm"):
        FrozenBackbone("timm/resnet10t", 64)


def test_timm_models() -> None:
    pytest.importorskip("timm")
    assert FrozenBackbone("timm/resnet10t", 64).latent_dim == 512
    with pytest.raises(ValueError, match=r"timm has no model.*resnet10t"):
        FrozenBackbone("timm/resnet10x", 64)


def test_it_is_not_trained(demos_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flags = f"--policy.type=frozen_backbone {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)}"
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags.split(), f"--output_dir={tmp_path / 'run'}"])
    with pytest.raises(NotImplementedError, match="lerobot-wm init"):
        lerobot_train.main()


def test_a_policy_has_its_encoder_in_it(policy_path: Path) -> None:
    assert isinstance(load_encoder(str(policy_path)).world_model, FrozenBackbone)


def test_a_camera_is_needed() -> None:
    config = FrozenBackboneConfig(device="cpu")
    with pytest.raises(ValueError, match=r"cameras none"):
        config.validate_features()


@torch.no_grad()
def test_features_of_several_cameras_stand_beside_each_other() -> None:
    torch.manual_seed(0)
    two = FrozenBackbone("resnet18", 32, n_cameras=2)
    one = FrozenBackbone("resnet18", 32)
    one.load_state_dict(two.state_dict())
    left, right = torch.rand(2, 1, 4, 3, 48, 48)  # (B, T, 3, H, W) each
    features = two.embed(torch.cat([left, right], dim=2))
    assert features.shape == (1, 4, 2 * FEATURES)
    assert two.latent_dim == 2 * FEATURES
    torch.testing.assert_close(features, torch.cat([one.embed(left), one.embed(right)], dim=-1))


def test_what_frames_were_resized_to_before_decides_the_features_too() -> None:
    torch.manual_seed(0)
    plain = FrozenBackbone("resnet18", 32)
    before = {size: FrozenBackbone("resnet18", 32, frame_size=size) for size in ((32, 32), (16, 16))}
    for backbone in before.values():
        backbone.load_state_dict(plain.state_dict())
    own = encoder_fingerprint(plain)
    assert [encoder_fingerprint(backbone) == own for backbone in before.values()] == [True, False]
    cameras = {"observation.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 64))}
    config = FrozenBackboneConfig(device="cpu", input_features=cameras, backbone_image_size=32)
    assert FrozenBackbonePolicy(config).world_model.encoding_settings["frame_size"] == [48, 64]


def test_features_of_another_image_size_or_camera_are_not_taken_for_ones_own(
    tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    """Equal weights encode otherwise: their latents lie in a folder of their own, and are refused."""
    cameras = {
        FRONT: camera(32, 32),
        WRIST: camera(32, 32),
        "action": vector(2),
        "observation.state": vector(3),
    }
    dataset = record(tmp_path / "dataset", cameras, [("Reach", 6)])
    meta = LeRobotDatasetMetadata("test/recorded", root=dataset.root)
    roots = {}
    for name, options in {
        "small": f"--policy.backbone_image_size=32 --policy.image_key={FRONT}",
        "large": f"--policy.backbone_image_size=64 --policy.image_key={FRONT}",
        "wrist": f"--policy.backbone_image_size=32 --policy.image_key={WRIST}",
    }.items():
        lerobot_wm_command(
            f"init --policy.type=frozen_backbone --policy.backbone=resnet18 {options} --policy.device=cpu --seed=3",
            f"--dataset.repo_id=test/recorded --dataset.root={dataset.root} --output_dir={tmp_path / name}",
        )
        path = str(tmp_path / name / "pretrained_model")
        roots[name] = encode_to_cache(path, "test/recorded", meta, "cpu")
    assert len(set(roots.values())) == 3
    latents = LeRobotDatasetMetadata("test/latents", root=roots["small"])
    for name, message in (
        ("large", "world model"),
        ("wrist", f"{FRONT}.*{WRIST}"),
    ):
        config = make_policy_config(
            "wm_bc", world_model_path=str(tmp_path / name / "pretrained_model"), device="cpu"
        )
        with pytest.raises(ValueError, match=message):
            make_policy(config, ds_meta=latents)

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.datasets.io_utils import load_stats, write_stats
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors.torch import load_file, save_file

from lerobot_wm.data.loader import RamDataset
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS

SHORT = "--policy.type=wm_rssm --steps=2 --batch_size=2 --log_freq=1 --policy.window_length=4"


def test_losses_are_logged_by_name(world_model_path: Path) -> None:
    log = world_model_path.parents[2] / "train_log.jsonl"
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["step"] for line in lines] == [4, 8, 12]
    assert {"loss", "image_loss", "reward_loss", "kl_loss", "kl", "under_free_nats"} <= lines[0].keys()
    assert lines[-1]["image_loss"] < lines[0]["image_loss"]


def test_checkpoint_round_trip(world_model_path: Path) -> None:
    policy = WMRSSMPolicy.from_pretrained(world_model_path)
    stored = load_file(world_model_path / "model.safetensors")
    assert all(torch.equal(tensor, stored[name]) for name, tensor in policy.state_dict().items())
    assert policy.config.rssm.action_dim == 4
    assert policy.config.image_key == "observation.image"


def test_resume_is_exact(
    world_model_path: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    """A run cut off after its first checkpoint and resumed ends with the weights of the undisturbed run."""
    run_folder = tmp_path / "run"
    shutil.copytree(world_model_path.parents[1], run_folder / "checkpoints", symlinks=True)
    shutil.rmtree(run_folder / "checkpoints" / "000012")
    config = run_folder / "checkpoints" / "000006" / "pretrained_model" / "train_config.json"
    lerobot_wm_command(f"train --config_path={config} --resume=true --output_dir={run_folder}")
    resumed = load_file(run_folder / "checkpoints" / "000012" / "pretrained_model" / "model.safetensors")
    for name, tensor in load_file(world_model_path / "model.safetensors").items():
        assert torch.equal(tensor, resumed[name]), name


def test_plain_lerobot_train_takes_the_same_flags(
    demos: LeRobotDataset, demos_root: Path, tmp_path: Path, lerobot_train_command: Callable[[str], None]
) -> None:
    flags = f"{SHORT} {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)} --output_dir={tmp_path / 'run'}"
    lerobot_train_command(f"{flags} --policy.rssm.standardize_images=true")
    policy = WMRSSMPolicy.from_pretrained(tmp_path / "run" / "checkpoints" / "last" / "pretrained_model")
    assert policy.config.window_length == 4
    # The dataset's, not ImageNet's, which LeRobot puts in their place unless told not to.
    stats, scaling = demos.meta.stats["observation.image"], policy.world_model.image_scaling
    np.testing.assert_allclose(scaling.offset, stats["mean"].flatten(), rtol=1e-6)
    np.testing.assert_allclose(scaling.scale, stats["std"].flatten(), rtol=1e-6)


def test_a_policy_acts_on_latents_of_larger_images(
    demos_root: Path, demos: LeRobotDataset, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    """The size reaches the frames in memory, the encoded dataset and the images at test time."""
    data = f"{TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)}"
    lerobot_wm_command(f"train {SHORT} {data} --policy.rssm.image_size=96 --output_dir={tmp_path / 'wm'}")
    world_model = tmp_path / "wm" / "checkpoints" / "last" / "pretrained_model"
    assert WMRSSMPolicy.from_pretrained(world_model).world_model.encoder.embed_dim == 256 * 6**2
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.world_model_path={world_model} --steps=2 --batch_size=4 {data}",
        f"--output_dir={tmp_path / 'bc'}",
    )
    policy = WMBCPolicy.from_pretrained(tmp_path / "bc" / "checkpoints" / "last" / "pretrained_model")
    assert policy.config.image_size == (96, 96)
    frame = demos[0]
    batch = {key: frame[key][None] for key in ("observation.image", "observation.state")}
    assert policy.select_action({**batch, "task": [frame["task"]]}).isfinite().all()


def test_images_without_statistics_are_not_scaled(
    demos: LeRobotDataset, demos_root: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    """LeRobot's own `recompute_stats` leaves images out."""
    root = tmp_path / "dataset"
    shutil.copytree(demos_root, root)
    stats = load_stats(root)
    del stats["observation.image"]
    write_stats(stats, root)
    flags = f"{SHORT} {TRAIN_FLAGS} {DATASET_FLAGS.format(root=root)} --dataset.use_imagenet_stats=false"
    lerobot_wm_command(f"train {flags} --output_dir={tmp_path / 'run'}")
    flags += f" --output_dir={tmp_path / 'scaled'}"
    with pytest.raises(ValueError, match=r"'mean' of 'observation\.image'.*leave out .*standardize_images"):
        lerobot_wm_command(f"train {flags} --policy.rssm.standardize_images=true")


def test_held_out_loss(
    demos_root: Path,
    tmp_path: Path,
    lerobot_wm_command: Callable[..., None],
    capfd: pytest.CaptureFixture[str],
) -> None:
    lerobot_wm_command(
        f"train {SHORT} {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)} --dataset.eval_split=0.25",
        f"--eval_steps=2 --max_eval_samples=8 --output_dir={tmp_path / 'run'}",
    )
    assert "eval_loss=" in capfd.readouterr().err


def test_proprioceptive_variant_trains(
    demos_root: Path, tmp_path: Path, lerobot_wm_command: Callable[..., None]
) -> None:
    lerobot_wm_command(
        f"train {SHORT} {TRAIN_FLAGS} {DATASET_FLAGS.format(root=demos_root)}",
        f"--policy.rssm.use_proprio=true --output_dir={tmp_path / 'run'}",
    )
    log = (tmp_path / "run" / "train_log.jsonl").read_text().splitlines()
    assert json.loads(log[-1])["proprio_loss"] > 0


def test_a_world_model_chooses_no_actions(world_model_path: Path) -> None:
    with pytest.raises(NotImplementedError, match="wm_bc"):
        WMRSSMPolicy.from_pretrained(world_model_path).select_action({})


def test_other_action_size_is_refused(world_model_path: Path) -> None:
    config = WMRSSMPolicy.from_pretrained(world_model_path).config
    config.output_features["action"].shape = (7,)
    with pytest.raises(ValueError, match="action_dim 4, here it is 7"):
        config.validate_features()


@pytest.mark.parametrize("fault", ["missing key", "extra key", "NaN", "cut short"])
def test_broken_checkpoints_are_refused(world_model_path: Path, tmp_path: Path, fault: str) -> None:
    broken = tmp_path / "checkpoint"
    shutil.copytree(world_model_path, broken)
    weights = broken / "model.safetensors"
    tensors = load_file(weights)
    name = "world_model.rssm.gru.weight_ih"
    if fault == "missing key":
        del tensors[name]
    elif fault == "extra key":
        tensors["world_model.surprise"] = torch.zeros(1)
    elif fault == "NaN":
        tensors[name][0, 0] = float("nan")
    save_file(tensors, weights)
    if fault == "cut short":
        weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"model\.safetensors"):
        WMRSSMPolicy.from_pretrained(broken)


def test_episodes_shorter_than_a_window_are_trained_on(
    tmp_path: Path, lerobot_wm_command: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sampler that kept every window of 6 within its episode would leave out the first one as a whole."""
    image = {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]}
    action = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
    dataset = LeRobotDataset.create(
        "test/short",
        10,
        {"observation.image": image, "action": action},
        root=tmp_path / "dataset",
        use_videos=False,
    )
    rng = np.random.default_rng(0)
    for length in (3, 10, 6):
        for _ in range(length):
            frame = {
                "observation.image": rng.integers(0, 255, (64, 64, 3), dtype=np.uint8),
                "action": rng.random(2, dtype=np.float32),
                "task": "wave",
            }
            dataset.add_frame(frame)
        dataset.save_episode()
    dataset.finalize()

    drawn: list[int] = []
    batch = RamDataset.batch

    def noting_rows(self: RamDataset, rows: list[int]) -> dict[str, Any]:
        drawn.extend(rows)
        return batch(self, rows)

    monkeypatch.setattr(RamDataset, "batch", noting_rows)
    lerobot_wm_command(  # one epoch in one step
        "train --policy.type=wm_rssm --steps=1 --batch_size=13 --policy.window_length=6 --log_freq=1",
        f"{TRAIN_FLAGS} --dataset.repo_id=test/short --dataset.root={tmp_path / 'dataset'}",
        f"--output_dir={tmp_path / 'run'}",
    )
    assert sorted(drawn) == [0, *range(3, 11), *range(13, 17)]
    log = json.loads((tmp_path / "run" / "train_log.jsonl").read_text())
    assert np.isfinite(log["loss"])


def test_what_pads_a_window_counts_for_nothing(world_model_path: Path) -> None:
    policy = WMRSSMPolicy.from_pretrained(world_model_path).train()
    generator = torch.Generator().manual_seed(0)
    batch = {
        "observation.image": torch.rand(2, 5, 3, 64, 64, generator=generator),
        "action": torch.rand(2, 5, 4, generator=generator),
        "next.reward": torch.rand(2, 5, generator=generator),
        "action_is_pad": torch.tensor([[False] * 5, [False, False, True, True, True]]),
    }
    padded = {key: value.clone() for key, value in batch.items()}
    for key in ("observation.image", "action", "next.reward"):
        padded[key][1, 2:] = 0.5
    losses = []
    for each in (batch, padded):
        torch.manual_seed(0)
        losses.append(policy.forward(each)[0].item())
    assert losses[0] == losses[1]

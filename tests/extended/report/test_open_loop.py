"""Open-loop prediction with a real (untrained) world model on real frames."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy

from lerobot_wm.constants import ACTION, OBS_IMAGE, OBS_STATE
from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import load_world_model
from lerobot_wm.inspect.open_loop import (
    CONTEXT,
    HORIZONS,
    WINDOW,
    OpenLoop,
    open_loop,
    strips_figure,
)
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_rssm.modeling_wm_rssm import WMRSSMPolicy
from tests.flags import SMALL_WORLD_MODEL


def imagined(policy: WMRSSMPolicy | LatentPolicy, repo_id: str, root: Path) -> list[OpenLoop]:
    return open_loop(policy, LeRobotDatasetMetadata(repo_id, root=root), SourceConfig(repo_id, str(root)))


@torch.no_grad()
def test_imagination_follows_the_episodes_actions(untrained_path: Path, episodes_root: Path) -> None:
    """Equal to one step at a time: frame t is reached by the action executed at frame t - 1."""
    policy = load_world_model(str(untrained_path))
    results = imagined(policy, "test/episodes", episodes_root)
    assert [(result.task, result.n_episodes) for result in results] == [
        ("Reach a goal position", 1),
        ("Push and close a window", 1),
    ]

    frames = [LeRobotDataset("test/episodes", root=episodes_root)[i] for i in range(WINDOW)]
    model, state, previous = policy.world_model, None, torch.zeros(1, 1, 4)
    for frame in frames[:CONTEXT]:
        state = model.observe(frame[OBS_IMAGE][None, None], previous, state).last()
        previous = frame[ACTION][None, None]
    errors, copy_errors = [], []
    for t in range(CONTEXT, WINDOW):
        state = model.imagine(state, frames[t - 1][ACTION][None, None]).last()
        image = model.decode(state.latent)[0]
        torch.testing.assert_close(
            torch.from_numpy(results[0].imagined[t - CONTEXT]), image, atol=1e-5, rtol=0
        )
        np.testing.assert_array_equal(results[0].truth[t], frames[t][OBS_IMAGE])
        errors.append(float((image - frames[t][OBS_IMAGE]).square().mean()))
        copy_errors.append(float((frames[CONTEXT - 1][OBS_IMAGE] - frames[t][OBS_IMAGE]).square().mean()))
    for psnr, all_errors in ((results[0].psnr, errors), (results[0].copy_psnr, copy_errors)):
        assert psnr == pytest.approx([-10 * np.log10(all_errors[h - 1]) for h in HORIZONS], abs=1e-3)


def test_strips_show_truth_above_imagination(untrained_path: Path, episodes_root: Path) -> None:
    results = imagined(load_world_model(str(untrained_path)), "test/episodes", episodes_root)
    axes = np.array(strips_figure(results).axes).reshape(2 * len(results), -1)
    shown = axes[2, 3].images[0].get_array()
    np.testing.assert_array_equal(shown, results[1].truth[CONTEXT - 1 + HORIZONS[2]].transpose(1, 2, 0))
    shown = axes[3, 3].images[0].get_array()
    np.testing.assert_array_equal(shown, results[1].imagined[HORIZONS[2] - 1].transpose(1, 2, 0))


def test_data_without_proprioception(tmp_path: Path, lerobot_wm_command: Callable[..., None]) -> None:
    features = {
        OBS_IMAGE: {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
        ACTION: {"dtype": "float32", "shape": (2,), "names": None},
    }
    root, images = tmp_path / "data", np.random.default_rng(0)
    dataset = LeRobotDataset.create("test/images", 10, features, root=root, use_videos=False)
    for _ in range(WINDOW):
        image = images.integers(0, 256, (64, 64, 3), dtype=np.uint8)
        dataset.add_frame({OBS_IMAGE: image, ACTION: np.zeros(2, np.float32), "task": "look"})
    dataset.save_episode()
    dataset.finalize()
    lerobot_wm_command(
        f"init --policy.type=wm_rssm {SMALL_WORLD_MODEL} --dataset.repo_id=test/images --dataset.root={root}",
        f"--output_dir={tmp_path / 'init'}",
    )
    policy = load_world_model(str(tmp_path / "init" / "pretrained_model"))
    [result] = imagined(policy, "test/images", root)
    assert (result.task, result.n_episodes) == ("look", 1)


def test_a_policy_that_is_blind_is_refused(untrained_path: Path, tmp_path: Path) -> None:
    features = PreTrainedConfig.from_pretrained(untrained_path)
    config = WMBCConfig(
        use_latent=False,
        tasks=["Reach a goal position"],
        input_features={OBS_STATE: features.input_features[OBS_STATE]},
        output_features=features.output_features,
        device="cpu",
        push_to_hub=False,
    )
    WMBCPolicy(config).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=r"\(wm_bc\) holds no world model"):
        load_world_model(str(tmp_path))


def test_a_checkpoint_without_a_world_model_is_refused(untrained_path: Path, tmp_path: Path) -> None:
    features = PreTrainedConfig.from_pretrained(untrained_path)
    config = ACTConfig(
        input_features=features.input_features,
        output_features=features.output_features,
        dim_model=16,
        n_heads=2,
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
    )
    ACTPolicy(config).save_pretrained(tmp_path)
    with pytest.raises(ValueError, match=r"\(act\) holds no world model"):
        load_world_model(str(tmp_path))

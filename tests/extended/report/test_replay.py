"""Replay: policies are shown recorded frames, and their actions are compared with the recorded ones."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_wm.data.source import SourceConfig
from lerobot_wm.inspect.episodes import CheckpointConfig
from lerobot_wm.inspect.replay import (
    HOLD,
    OWN,
    RECORDED,
    REPEAT,
    ReplayConfig,
    joint_names,
    replay,
    trained_episodes,
)
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from tests.flags import DATASET_FLAGS, TRAIN_FLAGS

# LeRobot's own policies, at a small size.
ACT = (
    "--policy.type=act --policy.chunk_size=4 --policy.n_action_steps=4 --policy.dim_model=16 --policy.n_heads=2 "
    "--policy.dim_feedforward=16 --policy.n_encoder_layers=1 --policy.use_vae=false "
    "--policy.pretrained_backbone_weights=null"
)
DIFFUSION = (
    "--policy.type=diffusion --policy.horizon=8 --policy.n_action_steps=4 --policy.down_dims=[16,32] "
    "--policy.n_groups=4 --policy.diffusion_step_embed_dim=16 --policy.num_train_timesteps=4 "
    "--policy.spatial_softmax_num_keypoints=4 --policy.pretrained_backbone_weights=null --policy.use_group_norm=true"
)


def test_own_actions_are_those_of_a_rollout_and_recorded_ones_those_of_the_latents(
    demos: LeRobotDataset, policy_paths: dict[str, Path]
) -> None:
    path = policy_paths["wm_bc"]
    source = SourceConfig("test/demos", str(demos.root))
    result = replay(ReplayConfig(CheckpointConfig(str(path)), source, episodes=[1]))
    policy = WMBCPolicy.from_pretrained(path)
    start = demos.meta.episodes["length"][0]
    frames = [demos[start + t] for t in range(demos.meta.episodes["length"][1])]
    inputs = [
        {key: frame[key][None] for key in policy.config.input_features} | {"task": [frame["task"]]}
        for frame in frames
    ]
    recorded = torch.stack([frame["action"] for frame in frames])
    assert np.array_equal(result.recorded[1], recorded.numpy())
    own = torch.cat([policy.select_action(batch) for batch in inputs])
    name = "run"
    torch.testing.assert_close(torch.from_numpy(result.actions[f"{name}, {OWN}"][1]), own, rtol=0, atol=1e-5)
    policy.reset()
    told = []
    for t, batch in enumerate(inputs):
        if t:
            policy.executed(recorded[t - 1 : t])
        told.append(policy.select_action(batch))
    torch.testing.assert_close(
        torch.from_numpy(result.actions[f"{name}, {RECORDED}"][1]), torch.cat(told), rtol=0, atol=1e-5
    )
    assert not np.allclose(result.actions[f"{name}, {OWN}"][1], result.actions[f"{name}, {RECORDED}"][1])
    assert np.array_equal(result.actions[REPEAT][1][1:], result.recorded[1][:-1])
    state = torch.stack([frame["observation.state"] for frame in frames])
    assert np.array_equal(result.actions[HOLD][1], state.numpy())
    error = np.abs(own.numpy() - recorded.numpy()).mean(0) / np.asarray(demos.meta.stats["action"]["std"])
    assert result.in_std(result.errors(f"{name}, {OWN}", [1])) == pytest.approx(error, abs=1e-4)


@pytest.mark.parametrize(
    ("flags", "needs"), [(ACT, None), (DIFFUSION, "diffusers")], ids=["act", "diffusion"]
)
def test_the_command_compares_policies_on_what_was_held_out(
    flags: str,
    needs: str | None,
    demos: LeRobotDataset,
    demos_root: Path,
    lerobot_wm_command: Callable[..., None],
    lerobot_train_command: Callable[[str], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if needs is not None:
        pytest.importorskip(needs, reason="pip install 'lerobot[diffusion]'")
    data = DATASET_FLAGS.format(root=demos_root)
    train = f"--steps=4 --batch_size=8 {TRAIN_FLAGS} {data} --dataset.eval_split=0.25"
    lerobot_wm_command(
        f"train --policy.type=wm_bc --policy.use_latent=false {train} --output_dir={tmp_path / 'blind'}"
    )
    lerobot_train_command(f"{flags} {train} --output_dir={tmp_path / 'other'}")
    blind, other = (tmp_path / run / "checkpoints/last/pretrained_model" for run in ("blind", "other"))
    # The preprocessor of a policy that was trained on another device.
    steps = json.loads((blind / "policy_preprocessor.json").read_text())
    for step in steps["steps"]:
        if step["registry_name"] == "device_processor":
            step["config"]["device"] = "cuda"
    (blind / "policy_preprocessor.json").write_text(json.dumps(steps))
    # The last of each task's four episodes.
    assert set(range(8)) - trained_episodes(str(blind), demos.meta) == {3, 7}
    capsys.readouterr()
    lerobot_wm_command(
        f"replay --policy.path={blind} --compare=[{other}] {data} --output_dir={tmp_path / 'replay'}"
    )
    printed = capsys.readouterr().out
    assert "blind" in printed
    assert "other" in printed
    result = json.loads((tmp_path / "replay" / "replay.json").read_text())
    assert set(result["error_in_std"]) == {
        f"blind, {OWN}",
        f"other, {OWN}",
        REPEAT,
        HOLD,
    }
    assert {(row["episode"], row["held_out"]) for row in result["episodes"]} == {(3, True), (7, True)}
    assert all(len(row["error"]) == 4 for row in result["episodes"])
    for episode in (3, 7):
        assert (tmp_path / "replay" / f"episode_{episode}.png").read_bytes().startswith(b"\x89PNG")


def test_a_world_model_and_an_unknown_episode_are_refused(
    demos_root: Path, world_model_path: Path, policy_paths: dict[str, Path]
) -> None:
    source = SourceConfig("test/demos", str(demos_root))
    with pytest.raises(ValueError, match=r"wm_rssm.*chooses no actions"):
        replay(ReplayConfig(CheckpointConfig(str(world_model_path)), source))
    with pytest.raises(ValueError, match=r"test/demos.* 8 .*\[8\].*0 to 7"):
        replay(ReplayConfig(CheckpointConfig(str(policy_paths["wm_bc"])), source, episodes=[8]))


@pytest.mark.parametrize(
    ("names", "shown"),
    [
        (["lift", "turn"], ["lift", "turn"]),
        ({"motors": ["lift", "turn"]}, ["lift", "turn"]),
        (["j", "j"], ["0", "1"]),
    ],
)
def test_each_joint_has_a_name(names: object, shown: list[str], tmp_path: Path) -> None:
    action = {"dtype": "float32", "shape": (2,), "names": names}
    meta = LeRobotDatasetMetadata.create("a/b", 10, {"action": action}, root=tmp_path / "data")
    assert joint_names(meta) == shown

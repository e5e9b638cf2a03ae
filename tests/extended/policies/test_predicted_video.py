"""LeRobot's hook for predicted videos: what the world model expected to see beside what it saw."""

import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from lerobot.scripts import lerobot_eval
from torch import Tensor

from lerobot_wm.constants import ACTION, OBS_IMAGE, OBS_STATE, TASK
from lerobot_wm.envs.tasks import task_description
from lerobot_wm.policies.latent.policy import LatentPolicy
from lerobot_wm.policies.wm_bc.configuration_wm_bc import WMBCConfig
from lerobot_wm.policies.wm_bc.modeling_wm_bc import WMBCPolicy
from lerobot_wm.policies.wm_iql.configuration_wm_iql import WMIQLConfig
from lerobot_wm.policies.wm_iql.modeling_wm_iql import WMIQLPolicy
from lerobot_wm.policies.wm_rssm.configuration_wm_rssm import WMRSSMConfig
from lerobot_wm.world_model.config import RSSMConfig
from tests.extended.report.quality_model import lively_world_model

CAMERAS = [f"{OBS_IMAGE}s.corner2", f"{OBS_IMAGE}s.topview"]
POLICIES = {"wm_bc": (WMBCConfig, WMBCPolicy), "wm_iql": (WMIQLConfig, WMIQLPolicy)}


def make_policy(policy_type: str, cameras: list[str], **settings: Any) -> LatentPolicy:
    """An untrained policy for Meta-World on a small world model."""
    torch.manual_seed(0)
    config_class, policy_class = POLICIES[policy_type]
    sizes = {"deter_dim": 16, "stoch_dim": 8, "hidden_dim": 16, "reward_hidden_dim": 16}
    rssm = RSSMConfig(**sizes, image_channels=3 * len(cameras), action_dim=4)
    images = {key: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)) for key in cameras}
    inputs = {**images, OBS_STATE: PolicyFeature(FeatureType.STATE, (4,))}
    outputs = {ACTION: PolicyFeature(FeatureType.ACTION, (4,))}
    image_key = ",".join(cameras)
    shared = {"input_features": inputs, "output_features": outputs, "image_key": image_key, "device": "cpu"}
    defaults = {"world_model": WMRSSMConfig(rssm=rssm, **shared), "push_to_hub": False, **shared}
    tasks = [task_description("window-close-v3"), task_description("reach-v3")]
    config = config_class(tasks=tasks, **defaults | settings)
    return policy_class(config).eval()


@pytest.fixture
def policy(tmp_path: Path) -> LatentPolicy:
    """With two cameras; what it predicts depends on what it saw and did."""
    policy = make_policy("wm_bc", CAMERAS, save_predicted_video=True)
    policy.save_pretrained(tmp_path)
    policy.world_model.load_state_dict(lively_world_model(tmp_path).state_dict())
    return policy


def observations(n_steps: int, n_envs: int) -> list[dict[str, Any]]:
    """Batches of random frames of both cameras."""
    generator = torch.Generator().manual_seed(0)
    return [
        {
            **{key: torch.rand(n_envs, 3, 64, 64, generator=generator) for key in CAMERAS},
            OBS_STATE: torch.randn(n_envs, 4, generator=generator),
            TASK: [task_description("reach-v3")] * n_envs,
        }
        for _ in range(n_steps)
    ]


def gather(policy: LatentPolicy, steps: list[dict[str, Any]]) -> Tensor:
    """The video (T, H, W, C) of a rollout, gathered as lerobot-eval does."""
    policy.reset()
    latents = []
    for step in steps:
        policy.select_action(step)
        latents.append(policy.last_predicted_latents)
    return policy.decode_predicted_latents(torch.cat(latents, dim=2))


def bytes_of(images: Tensor) -> Tensor:
    """(C, H, W) in [0, 1] -> (H, W, C) uint8."""
    return (255 * images.movedim(0, -1)).round().byte()


@torch.inference_mode()
def test_frames_are_predicted_from_the_state_and_action_before(policy: LatentPolicy) -> None:
    steps = observations(n_steps=4, n_envs=1)
    video = gather(policy, steps)
    assert video.shape == (4, 64, 4 * 64, 3)  # two cameras predicted, two seen
    assert video.dtype == torch.uint8

    model = policy.world_model
    policy.reset()
    state, action = model.rssm.initial_state(1), torch.zeros(1, 4)
    for t, step in enumerate(steps):
        predicted = model.decode(model.imagine(state, action[:, None]).last().latent)[0]  # (6, 64, 64)
        pictures = [*predicted.chunk(2), *(step[key][0] for key in CAMERAS)]
        expected = torch.cat([bytes_of(picture) for picture in pictures], dim=1)
        assert (video[t].int() - expected.int()).abs().max() <= 1  # rounding
        action = policy.select_action(step)
        state = policy._filter_state
        reconstructed = torch.cat(
            [bytes_of(picture) for picture in model.decode(state.latent)[0].chunk(2)], dim=1
        )
        assert (video[t, :, :128].int() - reconstructed.int()).abs().max() > 1


def test_a_batch_of_rollouts_is_one_video_of_tiles(policy: LatentPolicy) -> None:
    steps = observations(n_steps=3, n_envs=5)
    together = gather(policy, steps)
    assert together.shape == (3, 2 * 66 + 2, 3 * 258 + 2, 3)  # three tiles in a row, two rows
    fourth = [{key: value[3:4] for key, value in step.items()} for step in steps]
    alone = gather(policy, fourth)
    tile = together[:, 68 : 68 + 64, 2 : 2 + 256]
    assert (tile.int() - alone.int()).abs().max() <= 1


def test_another_rollout_begins_anew(policy: LatentPolicy) -> None:
    steps = observations(n_steps=3, n_envs=2)
    assert torch.equal(gather(policy, steps), gather(policy, steps))


def test_nothing_is_decoded_unless_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = make_policy("wm_bc", CAMERAS)
    calls: list[Tensor] = []
    policy.world_model.decoder.register_forward_hook(lambda *arguments: calls.append(arguments[2]))
    policy.select_action(observations(1, 1)[0])
    assert policy.last_predicted_latents is None
    assert not calls


def test_without_a_world_model_nothing_predicts() -> None:
    with pytest.raises(ValueError, match=r"save_predicted_video=true, but this wm_bc has no world model"):
        make_policy(
            "wm_bc", [], world_model=None, use_latent=False, image_key=None, save_predicted_video=True
        )


@pytest.mark.parametrize("policy_type", POLICIES)
def test_lerobot_eval_writes_predicted_videos(
    policy_type: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = make_policy(policy_type, [OBS_IMAGE])
    policy.save_pretrained(tmp_path / "policy")
    for processor in make_pre_post_processors(policy.config):
        processor.save_pretrained(tmp_path / "policy")
    flags = (
        f"--policy.path={tmp_path / 'policy'} --policy.device=cpu --env.type=metaworld_mt "
        "--env.task=window-close-v3 --env.episode_length=5 --eval.n_episodes=4 --eval.batch_size=2 "
        "--eval.use_async_envs=false --seed=0"
    )
    for asked, written in (("true", 2), ("false", 0)):
        out = tmp_path / asked
        asking = f"--policy.save_predicted_video={asked} --output_dir={out}"
        monkeypatch.setattr(sys, "argv", ["lerobot-eval", *flags.split(), *asking.split()])
        lerobot_eval.main()
        videos = sorted(out.rglob("pred_episode_*.mp4"))
        assert [video.name for video in videos] == [f"pred_episode_{i}.mp4" for i in range(written)]
        assert len(list(out.rglob("eval_episode_*.mp4"))) == 4
    [of_first_rollout] = (tmp_path / "true").rglob("eval_episode_0.mp4")
    with av.open(str(of_first_rollout.with_name("pred_episode_0.mp4"))) as video:
        predicted = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    with av.open(str(of_first_rollout)) as video:
        real = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(predicted) == 5
    # The codec's chroma is coarse at 64 pixels: brightness is compared.
    left, right = (np.abs(predicted[3][2:66, x : x + 64].mean(-1) - real[3].mean(-1)).mean() for x in (2, 66))
    assert right < 10 < left

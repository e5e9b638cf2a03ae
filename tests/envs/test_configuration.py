import gymnasium as gym
import numpy as np
import pytest
from lerobot.configs import FeatureType
from lerobot.envs.factory import make_env
from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features, preprocess_observation

from lerobot_wm.constants import ACTION, MT6, OBS_ENV_STATE, OBS_IMAGE, OBS_STATE
from lerobot_wm.envs.configuration import MetaworldMTEnvConfig
from lerobot_wm.envs.variations import rand_vec


def test_policy_features() -> None:
    features = env_to_policy_features(MetaworldMTEnvConfig(image_size=96))
    assert {key: (feature.type, feature.shape) for key, feature in features.items()} == {
        OBS_IMAGE: (FeatureType.VISUAL, (3, 96, 96)),
        OBS_STATE: (FeatureType.STATE, (4,)),
        ACTION: (FeatureType.ACTION, (4,)),
    }


def test_tasks_at_once_are_refused() -> None:
    with pytest.raises(ValueError, match="lerobot-wm eval --num_workers"):
        MetaworldMTEnvConfig(max_parallel_tasks=2)


def test_environment_state_reaches_policies_under_lerobots_name() -> None:
    config = MetaworldMTEnvConfig(task="reach-v3", variation_set=43, environment_state=True)
    feature = env_to_policy_features(config)[OBS_ENV_STATE]
    assert (feature.type, feature.shape) == (FeatureType.ENV, (39,))
    vector_env = make_env(config, n_envs=2)["reach-v3"][0]
    observation, _ = vector_env.reset(seed=[4, 5])
    states = preprocess_observation(observation)[OBS_ENV_STATE]
    goals = [rand_vec("reach-v3", k, 43)[3:] for k in (4, 5)]
    np.testing.assert_allclose(states[:, 36:], goals, rtol=1e-6)
    vector_env.close()


def test_several_cameras_reach_policies_under_their_names() -> None:
    config = MetaworldMTEnvConfig(task="reach-v3", camera_name="corner2,topview", episode_length=1)
    keys = ["observation.images.corner2", "observation.images.topview"]
    features = env_to_policy_features(config)
    assert {key: features[key].shape for key in keys} == dict.fromkeys(keys, (3, 64, 64))
    assert OBS_IMAGE not in features
    vector_env = make_env(config, n_envs=2)["reach-v3"][0]
    batch = preprocess_observation(vector_env.reset(seed=[4, 5])[0])
    assert {key: tuple(batch[key].shape) for key in batch if "image" in key} == dict.fromkeys(
        keys, (2, 3, 64, 64)
    )
    observation = vector_env.step(np.ones((2, 4), dtype=np.float32))[0]
    frozen = vector_env.step(np.ones((2, 4), dtype=np.float32))[0]
    for camera in ("corner2", "topview"):
        np.testing.assert_array_equal(frozen["pixels"][camera], observation["pixels"][camera])
    vector_env.close()


def test_one_group_per_task_built_lazily() -> None:
    envs = make_env(MetaworldMTEnvConfig(), n_envs=50)
    assert list(envs) == list(MT6)
    for group in envs.values():
        assert list(group) == [0]
        assert group[0].num_envs == 50
        assert group[0].metadata["autoreset_mode"] is gym.vector.AutoresetMode.NEXT_STEP
        assert all(env.unwrapped._sim is None for env in group[0].envs)


@pytest.mark.parametrize("use_async", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_vector_rollout(use_async: bool) -> None:
    """Observations are what LeRobot's policies get; a finished sub-environment is frozen until a new rollout."""
    config = MetaworldMTEnvConfig(task="reach-v3", episode_length=3)
    vector_env = make_env(config, n_envs=2, use_async_envs=use_async)["reach-v3"][0]
    rollout = {NEW_ROLLOUT_OPTION: True}
    first, info = vector_env.reset(seed=[4, 5], options=rollout)
    assert info["variation"].tolist() == [4, 5]
    batch = preprocess_observation(first)
    assert batch[OBS_IMAGE].shape == (2, 3, 64, 64)
    assert batch[OBS_STATE].shape == (2, 4)
    assert list(vector_env.call("task_description")) == ["Reach a goal position"] * 2
    assert list(vector_env.call("_max_episode_steps")) == [3, 3]
    action = np.ones((2, 4), dtype=np.float32)
    for _ in range(3):
        observation, _, terminated, truncated, info = vector_env.step(action)
    assert truncated.all()
    assert not terminated.any()
    assert info["is_success"].tolist() == [False, False]
    for _ in range(3):
        frozen, reward, *_ = vector_env.step(action)
        np.testing.assert_array_equal(frozen["pixels"], observation["pixels"])
        assert reward.tolist() == [0.0, 0.0]
    again, _ = vector_env.reset(seed=[4, 5], options=rollout)
    np.testing.assert_array_equal(again["pixels"], first["pixels"])
    assert vector_env.call("render")[1].shape == (64, 64, 3)
    vector_env.close()

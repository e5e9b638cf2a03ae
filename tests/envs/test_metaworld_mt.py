from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lerobot_wm.constants import MT6
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
from lerobot_wm.envs.tasks import all_tasks

MakeEnv = Callable[..., MetaworldMTEnv]


def episode(env: MetaworldMTEnv, variation: int, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (T+1, 39) and images (T+1, H, W, 3) of a variation under fixed actions."""
    observation, _ = env.reset(seed=variation)
    states, images = [env.environment_state], [observation["pixels"]]
    for action in actions:
        observation = env.step(action)[0]
        states.append(env.environment_state)
        images.append(observation["pixels"])
    return np.array(states), np.array(images)


def check_reproducible(make_env: MakeEnv, task: str, actions: np.ndarray) -> None:
    fresh = episode(make_env(task), 3, actions)
    used = make_env(task)
    episode(used, 27, actions[::-1])
    again = episode(used, 3, actions)
    np.testing.assert_array_equal(fresh[0], again[0])
    np.testing.assert_array_equal(fresh[1], again[1])
    assert np.isfinite(fresh[0]).all()
    assert fresh[1].std() > 20  # a picture, not one colour
    assert (fresh[1][0] != fresh[1][-1]).any()


@pytest.mark.parametrize("task", MT6)
def test_reset_is_bitwise_reproducible(make_env: MakeEnv, actions: np.ndarray, task: str) -> None:
    check_reproducible(make_env, task, actions)


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(set(all_tasks()) - set(MT6)))
def test_every_other_task_too(make_env: MakeEnv, actions: np.ndarray, task: str) -> None:
    check_reproducible(make_env, task, actions)


@pytest.mark.parametrize("task", ["window-close-v3", "drawer-open-v3", "reach-v3"])
def test_first_frame_is_not_stale(make_env: MakeEnv, task: str) -> None:
    """Meta-World's own reset shows objects where the last episode left them, up to 0.2 m off."""
    env = make_env(task)
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.array([0.0, 1.0, -1.0, 1.0]))
    image = env.reset(seed=4)[0]["pixels"]
    mujoco.mj_forward(env._sim.model, env._sim.data)  # recomputes all positions
    np.testing.assert_array_equal(image, env._renderers["corner2"].render(env._sim.model, env._sim.data))
    before = env.environment_state
    env.step(np.zeros(4))
    assert np.abs(env.environment_state - before)[4:7].max() < 0.005  # the object hardly moves in 0.0125 s


def test_seed_picks_the_variation(make_env: MakeEnv) -> None:
    env = make_env("reach-v3")
    assert [env.reset(seed=seed)[1]["variation"] for seed in (0, 49, 50, 123)] == [0, 49, 0, 23]
    assert env.reset()[1]["variation"] == 24, "without a seed, the next one"


def test_the_second_set_holds_other_positions(make_env: MakeEnv, actions: np.ndarray) -> None:
    first, second = make_env("window-close-v3"), make_env("window-close-v3", variation_set=43)
    handles = [episode(env, 3, actions)[0][0, 4:7] for env in (first, second)]
    assert np.abs(handles[0] - handles[1]).max() > 0.01  # metres
    np.testing.assert_array_equal(episode(second, 3, actions)[0], episode(second, 53, actions)[0])


def test_environment_state_is_observed_on_demand(make_env: MakeEnv, actions: np.ndarray) -> None:
    env = make_env("window-close-v3", environment_state=True)
    observation, _ = env.reset(seed=0)
    for action in actions:
        assert env.observation_space.contains(observation)
        np.testing.assert_array_equal(
            observation["environment_state"], env.environment_state.astype(np.float32)
        )
        observation, *_ = env.step(action)
    assert "environment_state" not in make_env("window-close-v3").reset(seed=0)[0]


def test_several_cameras_are_those_seen_one_by_one(make_env: MakeEnv, actions: np.ndarray) -> None:
    cameras = ("topview", "corner2", "corner")
    env = make_env("reach-v3", camera_name=",".join(cameras))
    one_by_one = [episode(make_env("reach-v3", camera_name=camera), 3, actions)[1] for camera in cameras]
    observation, _ = env.reset(seed=3)
    for t, action in enumerate(actions):
        assert env.observation_space.contains(observation)
        assert tuple(observation["pixels"]) == cameras
        for camera, images in zip(cameras, one_by_one, strict=True):
            np.testing.assert_array_equal(observation["pixels"][camera], images[t])
        np.testing.assert_array_equal(env.render(), np.concatenate([x[t] for x in one_by_one], axis=1))
        observation, *_ = env.step(action)
    env.close()
    assert env.render().shape == (64, 192, 3)


def test_expert_succeeds_and_ends_the_episode(make_env: MakeEnv) -> None:
    from metaworld.policies import SawyerButtonPressTopdownV3Policy

    env = make_env("button-press-topdown-v3")
    expert = SawyerButtonPressTopdownV3Policy()
    _, info = env.reset(seed=2)
    assert info["is_success"] is False
    terminated, steps = False, 0
    while not terminated:
        action = np.clip(expert.get_action(env.environment_state), -1, 1)
        _, reward, terminated, truncated, info = env.step(action)
        steps += 1
        assert not truncated
        assert reward == float(info["is_success"]) == float(terminated)
        assert 0.0 <= info["dense_reward"] <= 10.0
    assert 30 < steps < 150


def test_truncation_without_success(make_env: MakeEnv) -> None:
    env = make_env("door-open-v3", episode_length=5)
    env.reset(seed=0)
    ends = [env.step(np.zeros(4))[2:4] for _ in range(5)]
    assert ends == [(False, False)] * 4 + [(False, True)]


@pytest.mark.parametrize("action", [np.zeros(3), np.array([0.0, np.nan, 0.0, 0.0]), np.zeros((1, 4))])
def test_bad_action_is_refused(make_env: MakeEnv, action: np.ndarray) -> None:
    env = make_env("reach-v3")
    env.reset(seed=7)
    with pytest.raises(ValueError, match="reach-v3, variation 7, step 0"):
        env.step(action)


def test_close_frees_and_reset_builds_again(make_env: MakeEnv, actions: np.ndarray) -> None:
    env = make_env("reach-v3")
    before = episode(env, 1, actions)
    env.close()
    env.close()
    after = episode(env, 1, actions)
    np.testing.assert_array_equal(before[1], after[1])


@pytest.mark.filterwarnings("ignore:.*")
def test_gymnasium_finds_no_fault(make_env: MakeEnv) -> None:
    check_env(make_env("reach-v3"), skip_render_check=True)

import os
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_wm.envs import rendering
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv

MakeEnv = Callable[..., MetaworldMTEnv]
TASKS = ("reach-v3", "door-open-v3", "window-close-v3")
FIRST_IMAGE = """
import sys, numpy as np
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
np.save(sys.argv[2], MetaworldMTEnv(sys.argv[1]).reset(seed=5)[0]["pixels"])
"""


def test_tasks_in_one_process_do_not_disturb_each_other(make_env: MakeEnv, tmp_path: Path) -> None:
    """A task's image is the same before others are drawn, after, and alone; nothing is said at exit."""
    first = make_env(TASKS[0])
    before = first.reset(seed=5)[0]["pixels"]
    others = [make_env(task).reset(seed=5)[0]["pixels"] for task in TASKS[1:]]
    np.testing.assert_array_equal(before, first.reset(seed=5)[0]["pixels"])
    command = [sys.executable, "-c", FIRST_IMAGE, TASKS[1], str(tmp_path / "alone.npy")]
    result = subprocess.run(command, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")
    np.testing.assert_array_equal(others[0], np.load(tmp_path / "alone.npy"))


def test_sub_environments_share_one_renderer(make_env: MakeEnv) -> None:
    others = set(rendering._renderers)  # of tests that ran before in this process
    envs = [make_env("reach-v3") for _ in range(4)]
    for k, env in enumerate(envs):
        env.reset(seed=k)
    [key] = rendering._renderers.keys() - others
    assert rendering._renderers[key].users == 4
    images = [env.step(np.zeros(4))[0]["pixels"] for env in envs]
    assert len({image.tobytes() for image in images}) == 4  # four goals
    for env in envs:
        env.close()
    assert rendering._renderers.keys() == others


def test_threads_may_render(make_env: MakeEnv) -> None:
    """LeRobot's --env.max_parallel_tasks evaluates tasks in threads and closes them in another one."""
    envs = [make_env(task) for task in TASKS]
    alone = [env.reset(seed=1)[0]["pixels"] for env in envs]
    with ThreadPoolExecutor(len(envs)) as pool:
        for _ in range(3):
            threaded = list(pool.map(lambda env: env.reset(seed=1)[0]["pixels"], envs))
            np.testing.assert_array_equal(alone, threaded)


def test_picture_is_lerobots(make_env: MakeEnv) -> None:
    """Camera, orientation and light are those of LeRobot's metaworld environment; only shadows are gone."""
    from lerobot.envs.metaworld import MetaworldEnv

    theirs_env = MetaworldEnv("door-open-v3", obs_type="pixels_agent_pos")
    theirs = theirs_env.reset(seed=0)[0]["pixels"].reshape(60, 8, 60, 8, 3).mean(axis=(1, 3))
    theirs_env.close()
    ours = make_env("door-open-v3", image_size=480).reset(seed=0)[0]["pixels"]
    ours = ours.reshape(60, 8, 60, 8, 3).mean(axis=(1, 3))
    assert np.abs(ours - theirs).mean() < 12
    assert np.abs(ours[::-1] - theirs).mean() > 30
    assert np.abs(ours[:, ::-1] - theirs).mean() > 30


@pytest.mark.parametrize("camera_name", ["corner", "topview", "gripperPOV"])
def test_cameras_and_slow_rendering(make_env: MakeEnv, camera_name: str) -> None:
    fast = make_env("drawer-open-v3", camera_name=camera_name, image_size=96).reset(seed=0)[0]["pixels"]
    slow_env = make_env("drawer-open-v3", camera_name=camera_name, image_size=96, fast_rendering=False)
    slow = slow_env.reset(seed=0)[0]["pixels"]
    assert fast.shape == slow.shape == (96, 96, 3)
    difference = np.abs(fast.astype(int) - slow).mean()
    assert 0.1 < difference < 30


def test_cameras_are_upright(make_env: MakeEnv) -> None:
    """Lifting the hand moves it up in the pictures of those mounted upside down."""
    for camera in ("corner2", "corner", "corner3"):
        env = make_env("reach-v3", camera_name=camera, image_size=64)
        before = env.reset(seed=0)[0]["pixels"].astype(int)
        for _ in range(15):
            after = env.step(np.array([0.0, 0.0, 1.0, -1.0]))[0]["pixels"].astype(int)
        rows = [fingers_row(image) for image in (before, after)]
        assert rows[1] < rows[0] - 1, camera  # rows are counted from the top


def fingers_row(image: np.ndarray) -> float:
    """Mean row of the gripper's fingers, white and cyan, in an image (H, W, 3)."""
    blue = image[..., 2] > 200
    return float(np.nonzero(blue)[0].mean())


def test_a_device_that_is_not_there_is_named_with_its_variable() -> None:
    code = "from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv; MetaworldMTEnv('reach-v3').reset(seed=0)"
    env = {**os.environ, "MUJOCO_GL": "egl", "MUJOCO_EGL_DEVICE_ID": "99"}
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert result.returncode == 1
    [message] = [
        line for line in result.stderr.splitlines() if line.startswith("RuntimeError: No headless OpenGL")
    ]
    assert "unset MUJOCO_EGL_DEVICE_ID" in message
    assert "apt-get" not in message


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is Linux's")
def test_a_display_elsewhere_is_not_drawn_on() -> None:
    """As in `ssh -X`, where GLFW draws nothing."""
    code = "from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv; MetaworldMTEnv('reach-v3').reset(seed=0)"
    env = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    subprocess.run([sys.executable, "-c", code], check=True, env={**env, "DISPLAY": "localhost:10.0"})


@pytest.mark.parametrize("camera", ["hand_top", "hand_side"])
def test_hand_cameras_move_with_the_hand(make_env: MakeEnv, camera: str) -> None:
    env = make_env("reach-v3", camera_name=camera)
    first = env.reset(seed=0)[0]
    positions, hands = [], []
    for _ in range(25):
        observation = env.step(np.array([1.0, 1.0, 0.5, -1.0]))[0]
        positions.append(np.array(env._renderers[camera]._scene.camera[0].pos))
        hands.append(observation["agent_pos"][:3])
    moved = np.array(hands[-1]) - hands[0]
    assert np.linalg.norm(moved) > 0.1
    np.testing.assert_allclose(
        positions[-1] - positions[0], moved, atol=0.02
    )  # the hand swings a little at the wrist
    assert not np.array_equal(first["pixels"], observation["pixels"])


def test_a_renderer_that_cannot_be_made_leaves_nothing_behind(
    make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each reset says what is wrong, `close` says nothing, and a renderer that was made is given back."""
    env = make_env("reach-v3", camera_name="corner2,topview")
    before = dict(rendering._renderers)
    acquire = rendering.Renderer.acquire

    def second_fails(key: rendering.RenderKey, model: Any) -> rendering.Renderer:
        if key.camera == "topview":
            raise RuntimeError("no OpenGL")
        return acquire(key, model)

    monkeypatch.setattr(rendering.Renderer, "acquire", second_fails)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="no OpenGL"):
            env.reset(seed=0)
    env.close()
    assert rendering._renderers == before

"""The robot drawn with fewer triangles: what is kept, and how near the picture stays."""

import copy
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from lerobot_wm.envs import rendering
from lerobot_wm.envs.metaworld_mt import MetaworldMTEnv
from lerobot_wm.envs.rendering import _nearest_to_means, _proper, simplify_robot
from lerobot_wm.envs.simulation import Simulation

CELL = 0.004
ROBOT = {"base", "pedestal", "head", "eGripperBase", *(f"l{link}" for link in range(7))}


def faces(model: Any, name: str) -> np.ndarray:
    """A mesh's triangles, (F, 3)."""
    mesh = model.mesh(name)
    return model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]


@pytest.fixture(scope="module")
def models() -> tuple[Any, Any]:
    """A task's model as Meta-World has it, and simplified."""
    model = Simulation("door-open-v3").model
    simplified = copy.copy(model)
    simplify_robot(simplified, CELL)
    return model, simplified


def test_the_robot_has_less_than_half_and_objects_have_all(models: tuple[Any, Any]) -> None:
    model, simplified = models
    names = {model.mesh(mesh).name for mesh in range(model.nmesh)}
    assert names > ROBOT
    for name in names - ROBOT:
        np.testing.assert_array_equal(faces(model, name), faces(simplified, name))
    before, after = (sum(len(faces(each, name)) for name in ROBOT) for each in models)
    assert before > 60_000
    assert after < before / 2


def test_no_vertex_moves_farther_than_a_cell_is_wide(models: tuple[Any, Any]) -> None:
    model, _ = models
    for name in ROBOT:
        mesh = model.mesh(name)
        vertices = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        standing_in = vertices[_nearest_to_means(vertices, CELL)]
        assert np.linalg.norm(standing_in - vertices, axis=1).max() <= CELL * np.sqrt(3) + 1e-6
        assert len(np.unique(standing_in, axis=0)) < len(np.unique(vertices, axis=0))


def test_the_vertex_nearest_to_the_mean_stands_for_its_cell() -> None:
    points = np.array([[0.1, 0.1, 0.1], [0.5, 0.5, 0.5], [0.8, 0.8, 0.9], [1.5, 0.5, 0.5], [-0.1, 0.5, 0.5]])
    assert _nearest_to_means(points, 1.0).tolist() == [1, 1, 1, 3, 4]


def test_closed_and_repeated_triangles_are_dropped() -> None:
    """A triangle turned is the same; seen from the other side it is another."""
    triangles = np.array([[4, 5, 6], [5, 6, 4], [4, 6, 5], [4, 4, 5], [4, 5, 4], [5, 4, 4], [6, 7, 4]])
    assert _proper(triangles).tolist() == [0, 2, 6]


def test_corners_keep_their_normals(models: tuple[Any, Any]) -> None:
    """Each drawn triangle's normals are those of one original triangle with vertices in the same cells."""
    model, simplified = models
    mesh, after = model.mesh("l0"), simplified.mesh("l0")
    start = mesh.faceadr[0]
    merged = _nearest_to_means(model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]], CELL)
    before = {
        (*merged[face], *normal)
        for face, normal in zip(
            faces(model, "l0"), model.mesh_facenormal[start : start + mesh.facenum[0]], strict=True
        )
    }
    drawn = zip(
        faces(simplified, "l0"),
        simplified.mesh_facenormal[start : start + after.facenum[0]],
        strict=True,
    )
    assert all((*face, *normal) in before for face, normal in drawn)


@pytest.mark.parametrize("size", [64, 128])
def test_the_picture_is_nearly_the_same(
    make_env: Callable[..., MetaworldMTEnv], monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    """And the simulation's model is left alone: a policy's physics do not depend on how it is drawn."""
    # A camera whose renderers no other test holds.
    env = make_env("window-open-v3", image_size=size, camera_name="corner3")
    simplified = env.reset(seed=3)[0]["pixels"].astype(int)
    assert env._sim is not None
    model: mujoco.MjModel = env._sim.model
    assert sum(len(faces(model, name)) for name in ROBOT) > 60_000
    assert model.vis.quality.shadowsize > 0
    env.close()
    monkeypatch.setattr(rendering, "simplify_robot", lambda model, cell: None)
    whole = make_env("window-open-v3", image_size=size, camera_name="corner3").reset(seed=3)[0]["pixels"]
    assert 0 < np.abs(simplified - whole).mean() < 0.5 * 64 / size

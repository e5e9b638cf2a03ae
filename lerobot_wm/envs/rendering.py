"""Fast offscreen rendering of MuJoCo models.

Shadow maps, multisampling and reflections take nine tenths of Meta-World's rendering time at small sizes and carry no
information that a policy needs: they are off by default, and the robot is drawn without details of a fifth of a pixel.

All OpenGL calls of a process are made by one thread with one context. A context belongs to the thread that created it,
but environments may be used from any thread; and two contexts in one thread draw into each other's images unless they
are switched.
"""

import atexit
import copy
import importlib
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from lerobot_wm.envs.cameras import HAND_CAMERAS, HAND_VIEW_CENTER, UPSIDE_DOWN
from lerobot_wm.system import opengl_fix


def simplify_robot(model: Any, cell: float) -> None:
    """Simplify the robot's meshes by vertex clustering (Rossignac and Borrel, 1993); objects keep theirs.

    Vertices in the same cell of a grid are merged into the one nearest to their mean, so that none moves by more than
    the cell's diagonal, and triangles without area are dropped. Corners keep their normals.

    Args:
        model: mujoco.MjModel of a Meta-World task; its triangles are replaced.
        cell: Edge of the cells in metres.
    """
    for mesh in _robot_meshes(model):
        first_vertex, vertices = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        first_face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        merged = _nearest_to_means(model.mesh_vert[first_vertex : first_vertex + vertices], cell)  # (V,)
        triangles = merged[model.mesh_face[first_face : first_face + faces]]  # (F, 3)
        kept = _proper(triangles)
        left = slice(first_face, first_face + len(kept))
        model.mesh_face[left] = triangles[kept]
        model.mesh_facenormal[left] = model.mesh_facenormal[first_face + kept]
        model.mesh_facenum[mesh] = len(kept)


def _robot_meshes(model: Any) -> np.ndarray:
    """Indices of the meshes of the body that the hand belongs to."""
    robot = model.body_rootid[model.body("hand").id]
    of_robot = model.body_rootid[model.geom_bodyid] == robot
    return np.unique(model.geom_dataid[of_robot & (model.geom_dataid >= 0)])


def _nearest_to_means(points: np.ndarray, cell: float) -> np.ndarray:
    """For each of the points (V, 3), the index (V,) of the point that its cell is merged into."""
    _, cells = np.unique(np.floor(points / cell), axis=0, return_inverse=True)
    cells = cells.reshape(-1)  # numpy 2.0 returned (V, 1)
    count = np.bincount(cells)
    means = np.stack([np.bincount(cells, axis) / count for axis in points.T], axis=1)  # (cells, 3)
    distance = np.linalg.norm(points - means[cells], axis=1)
    by_cell = np.lexsort((distance, cells))
    return by_cell[np.searchsorted(cells[by_cell], cells)]


def _proper(triangles: np.ndarray) -> np.ndarray:
    """Indices, in ascending order, of triangles (F, 3) with three different corners, each triangle once."""
    # Start from the lowest corner, with the same orientation.
    turns = (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(triangles, turns, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    is_open = (turned[:, 0] < turned[:, 1]) & (turned[:, 1] != turned[:, 2]) & (turned[:, 0] < turned[:, 2])
    return np.sort(first[is_open[first]])


if sys.platform == "linux":
    # Even with a display, which may be on another machine, where GLFW draws nothing. MuJoCo reads it when imported.
    os.environ.setdefault("MUJOCO_GL", "egl")


def _no_opengl(error: Exception) -> RuntimeError:
    """The error for OpenGL that does not start: the reason that was found, and how to fix it."""
    backend = os.environ.get("MUJOCO_GL") or "unset"
    return RuntimeError(f"No headless OpenGL (MUJOCO_GL={backend}; {error}): {opengl_fix(str(error))}.")


try:
    # Loads the backend of MUJOCO_GL; without libEGL, PyOpenGL raises an AttributeError.
    import mujoco
except (AttributeError, RuntimeError, OSError) as error:
    raise _no_opengl(error) from error

# Largest number of geoms in a scene; Meta-World's have up to about 100.
MAX_GEOMS = 1000
# Vertices of the robot are merged within this length (m) divided by the image's width in pixels: at 64x64, where a
# pixel of a fixed camera shows 2 cm, within 4 mm.
DETAIL = 0.256


class RenderKey(NamedTuple):
    """Environments with the same key share a renderer: they have the same meshes, drawn in the same way."""

    task: str
    camera: str
    size: int
    fast: bool


_gl_thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="mujoco-gl")
_gl_context: Any = None
_renderers: dict[RenderKey, "Renderer"] = {}


class Renderer:
    """A task's meshes and textures in OpenGL for one camera, shared by all environments of that task.

    `acquire` one and `release` it after use; creating one takes 0.1 to 0.4 s.
    """

    def __init__(self, key: RenderKey, model: Any) -> None:
        self.users = 0
        self._upside_down = key.camera in UPSIDE_DOWN
        _ensure_gl_context()
        # A copy to draw with, so that the simulation's model stays as it is.
        model = copy.copy(model)
        model.vis.global_.offwidth = model.vis.global_.offheight = key.size
        if key.fast:
            model.vis.quality.offsamples = 0
            model.vis.quality.shadowsize = 0
            simplify_robot(model, DETAIL / key.size)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._scene = mujoco.MjvScene(model, MAX_GEOMS)
        if key.fast:
            self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._camera = mujoco.MjvCamera()
        self._follows_hand = key.camera in HAND_CAMERAS
        if self._follows_hand:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
            self._camera.azimuth, self._camera.elevation, self._camera.distance = HAND_CAMERAS[key.camera]
        else:
            self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
            self._camera.fixedcamid = model.camera(key.camera).id
        self._options = mujoco.MjvOption()
        self._viewport = mujoco.MjrRect(0, 0, key.size, key.size)

    @staticmethod
    def acquire(key: RenderKey, model: Any) -> "Renderer":
        """The process's renderer for a key, created from `model` (mujoco.MjModel) on first use."""
        return _gl_thread.submit(_acquire, key, model).result()

    @staticmethod
    def release(key: RenderKey) -> None:
        """Release a renderer; the last user frees its OpenGL memory."""
        _gl_thread.submit(_release, key).result()

    def render(self, model: Any, data: Any) -> np.ndarray:
        """Render a state (mujoco.MjModel, mujoco.MjData) as an upright uint8 RGB image (size, size, 3)."""
        return _gl_thread.submit(self._render, model, data).result()

    def _render(self, model: Any, data: Any) -> np.ndarray:
        image = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        # Each renderer has its own framebuffer in the one context.
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        if self._follows_hand:
            self._camera.lookat[:] = data.body("hand").xpos + HAND_VIEW_CENTER
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._options, None, self._camera, everything, self._scene)
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, self._viewport, self._context)
        # OpenGL's rows run upwards, so they are reversed. For a camera that is mounted upside down both axes are
        # reversed once more, which leaves the columns.
        return np.ascontiguousarray(image[:, ::-1] if self._upside_down else image[::-1])


def _acquire(key: RenderKey, model: Any) -> Renderer:
    if key not in _renderers:
        _renderers[key] = Renderer(key, model)
    _renderers[key].users += 1
    return _renderers[key]


def _release(key: RenderKey) -> None:
    _renderers[key].users -= 1
    if _renderers[key].users == 0:
        _renderers.pop(key)._context.free()


def _ensure_gl_context() -> None:
    """Create the process's OpenGL context.

    Raises:
        RuntimeError: There is no working headless OpenGL; says why, and how to fix it.
    """
    global _gl_context
    if _gl_context is not None:
        return
    backend = os.environ.get("MUJOCO_GL", "")
    module = f"mujoco.{backend}" if backend in ("egl", "osmesa", "glfw") else "mujoco.gl_context"
    try:
        # The size is unused in offscreen rendering.
        context = importlib.import_module(module).GLContext(1, 1)
        context.make_current()
    except (ImportError, AttributeError, RuntimeError, OSError, ValueError) as error:
        # PyOpenGL reports a missing library as an AttributeError on None, MuJoCo a device that is no number as a
        # ValueError.
        raise _no_opengl(error) from error
    _gl_context = context
    # Runs before the display is terminated; otherwise OpenGL prints errors at exit.
    atexit.register(_free_gl)


def _free_gl() -> None:
    for renderer in _renderers.values():
        renderer._context.free()
    _renderers.clear()
    _gl_context.free()

"""Fast offscreen rendering of MuJoCo models.

Shadow maps, multisampling and reflections take nine tenths of Meta-World's drawing time at small sizes and
carry no information a policy needs: they are off by default, and the robot is drawn without details of a fifth of
a pixel. All OpenGL calls of a process are made by one
thread with one context: a context is bound to the thread that made it, while environments may be used from any, and
two contexts in one thread draw into each other's images unless switched.
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


def simplify_robot(model: Any, cell: float) -> None:
    """Merge the vertices of the robot's links that share a cell of a grid, and drop the triangles that this closes.

    Of the vertices in a cell the one nearest to their mean stands for all (vertex clustering: Rossignac and Borrel
    1993), so none moves by more than the cell's diagonal. A corner keeps its normal. What a task is about, its
    objects, is left as it is.

    Args:
        model: mujoco.MjModel of a Meta-World task, to draw with: its triangles are replaced.
        cell: the cells' edge in metres.
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
    """Numbers of the meshes of the body that the hand is a part of."""
    robot = model.body_rootid[model.body("hand").id]
    of_robot = model.body_rootid[model.geom_bodyid] == robot
    return np.unique(model.geom_dataid[of_robot & (model.geom_dataid >= 0)])


def _nearest_to_means(points: np.ndarray, cell: float) -> np.ndarray:
    """For each of the points (V, 3) the index, (V,), of the one that stands for its cell."""
    _, cells = np.unique(np.floor(points / cell), axis=0, return_inverse=True)
    cells = cells.reshape(-1)  # numpy 2.0 returned (V, 1)
    count = np.bincount(cells)
    means = np.stack([np.bincount(cells, axis) / count for axis in points.T], axis=1)  # (cells, 3)
    distance = np.linalg.norm(points - means[cells], axis=1)
    by_cell = np.lexsort((distance, cells))
    return by_cell[np.searchsorted(cells[by_cell], cells)]


def _proper(triangles: np.ndarray) -> np.ndarray:
    """Indices, ascending, of the triangles (F, 3) that have three different corners, each triangle once."""
    turns = (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3  # from the lowest corner on, sides kept
    turned = np.take_along_axis(triangles, turns, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    is_open = (turned[:, 0] < turned[:, 1]) & (turned[:, 1] != turned[:, 2]) & (turned[:, 0] < turned[:, 2])
    return np.sort(first[is_open[first]])


if sys.platform == "linux":  # with a display, too: it may be another machine's, where GLFW draws nothing
    os.environ.setdefault("MUJOCO_GL", "egl")  # mujoco reads it when it is first imported

GL_HELP = (
    "No headless OpenGL to draw with (MUJOCO_GL={backend}). On Debian or Ubuntu run\n"
    "    apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri\n"
    "and use MUJOCO_GL=egl (the default)."
)
try:
    import mujoco  # which loads what MUJOCO_GL names, and without libEGL raises an AttributeError of PyOpenGL
except (AttributeError, RuntimeError, OSError) as error:
    raise RuntimeError(GL_HELP.format(backend=os.environ.get("MUJOCO_GL"))) from error

MAX_GEOMS = 1000  # of a scene; Meta-World's largest has about 100
# This length in metres over an image's width in pixels is how near vertices of the robot are merged: at 64x64, where a
# pixel of a fixed camera shows 2 cm, within 4 mm.
DETAIL = 0.256


class RenderKey(NamedTuple):
    """What environments must have in common to share a renderer: the same meshes, drawn the same way."""

    task: str
    camera: str
    size: int
    fast: bool


_gl_thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="mujoco-gl")
_gl_context: Any = None
_renderers: dict[RenderKey, "Renderer"] = {}


class Renderer:
    """A task's meshes and textures in OpenGL for one camera, shared by all sub-environments of that task.

    Get one with `acquire` and give it back with `release`; creating one takes 0.1-0.4 s.
    """

    def __init__(self, key: RenderKey, model: Any) -> None:
        self.users = 0
        self._upside_down = key.camera in UPSIDE_DOWN
        _ensure_gl_context()
        model = copy.copy(model)  # to draw with: the simulation's stays as it is
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
        """The process's renderer for `key`, created from `model` (mujoco.MjModel) on first use."""
        return _gl_thread.submit(_acquire, key, model).result()

    @staticmethod
    def release(key: RenderKey) -> None:
        """Give back a renderer; the last user frees its OpenGL memory."""
        _gl_thread.submit(_release, key).result()

    def render(self, model: Any, data: Any) -> np.ndarray:
        """Draw a state (mujoco.MjModel, mujoco.MjData) as an upright uint8 RGB image (size, size, 3)."""
        return _gl_thread.submit(self._render, model, data).result()

    def _render(self, model: Any, data: Any) -> np.ndarray:
        image = np.empty((self._viewport.height, self._viewport.width, 3), dtype=np.uint8)
        # Every task's renderer has its own framebuffer in the one context: select ours.
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        if self._follows_hand:
            self._camera.lookat[:] = data.body("hand").xpos + HAND_VIEW_CENTER
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._options, None, self._camera, everything, self._scene)
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, self._viewport, self._context)
        # OpenGL's rows run upwards: reversing them makes the image upright. A camera mounted upside down needs
        # both axes reversed on top, which leaves the columns.
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
    """Make the process's OpenGL context.

    Raises:
        RuntimeError: if this machine has no working headless OpenGL, with the packages to install.
    """
    global _gl_context
    if _gl_context is not None:
        return
    backend = os.environ.get("MUJOCO_GL", "")
    module = f"mujoco.{backend}" if backend in ("egl", "osmesa", "glfw") else "mujoco.gl_context"
    try:
        context = importlib.import_module(module).GLContext(1, 1)  # its size is unused: we draw offscreen
        context.make_current()
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        # PyOpenGL reports a missing library as an AttributeError on None.
        raise RuntimeError(GL_HELP.format(backend=backend or "unset")) from error
    _gl_context = context
    atexit.register(_free_gl)  # runs before the display is terminated, else OpenGL complains at exit


def _free_gl() -> None:
    for renderer in _renderers.values():
        renderer._context.free()
    _renderers.clear()
    _gl_context.free()

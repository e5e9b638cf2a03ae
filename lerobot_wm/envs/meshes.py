"""A robot of fewer triangles, for small images.

Drawing Meta-World's models in software takes time in proportion to their 67,000 triangles. Nearly all of them are the
robot's, whose links were drawn for manufacture, and far smaller than a pixel of a 64x64 image.
"""

from typing import Any

import numpy as np


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

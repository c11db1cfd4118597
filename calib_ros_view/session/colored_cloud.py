"""The point cloud in the colours of the image, for a view in three dimensions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.frame import Frame

CELLS_ACROSS = 320  # of the depth buffer over the image's width; wider than the gaps between rings would let points shine through
BEHIND = 1.05  # times the least depth of a cell, and BEHIND_M more, from which a point is hidden
BEHIND_M = 0.5
UNSEEN = (110, 110, 110)  # RGB of points that the camera does not see
MOST_POINTS = 60_000  # that a phone still turns smoothly


def colored_cloud(
    frame: Frame, T: Matrix, most: int = MOST_POINTS
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_]]:
    """The points of a frame, (n, 3) m in the LiDAR's frame, their colours (n, 3) RGB in its image at T_camera_lidar (4, 4), and
    whether the camera sees them (n,); those outside of the image, or hidden behind other points, are grey.

    most: points kept, drawn evenly; those in the image first, since they are what is looked at.
    """
    xyz = frame.cloud.finite().xyz
    P = se3.transform(T, xyz)
    uv, inside = frame.camera.project(P)
    visible = np.flatnonzero(inside)
    visible = visible[~_hidden(uv[visible], np.linalg.norm(P[visible], axis=1), frame.camera.width)]
    rgb = np.full((len(xyz), 3), UNSEEN, np.uint8)
    u, v = np.rint(uv[visible]).astype(np.intp).T
    image = frame.image if frame.image.ndim == 3 else np.repeat(frame.image[..., None], 3, axis=2)
    rgb[visible] = image[v, u, ::-1]
    seen = np.zeros(len(xyz), bool)
    seen[visible] = True
    kept = _drawn(seen, most, np.random.default_rng(0))
    return np.ascontiguousarray(xyz[kept]), rgb[kept], seen[kept]


def _hidden(uv: Matrix, depth: Matrix, width: int) -> NDArray[np.bool_]:
    """Points (n,) that lie behind nearer ones of the same cell of the image."""
    if not len(uv):
        return np.zeros(0, bool)
    cell = np.floor(uv * CELLS_ACROSS / width).astype(np.intp)
    flat = cell[:, 1] * (CELLS_ACROSS + 1) + cell[:, 0]
    nearest = np.full(int(flat.max()) + 1, np.inf)
    np.minimum.at(nearest, flat, depth)
    return np.asarray(depth > BEHIND * nearest[flat] + BEHIND_M)


def _drawn(seen: NDArray[np.bool_], most: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Positions (m,), ascending, of at most so many points, those that are seen before the others."""
    if len(seen) <= most:
        return np.arange(len(seen))
    first, others = np.flatnonzero(seen), np.flatnonzero(~seen)
    if len(first) >= most:
        return np.sort(rng.choice(first, most, replace=False))
    return np.sort(np.concatenate([first, rng.choice(others, most - len(first), replace=False)]))

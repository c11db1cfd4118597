"""Points of a scan on the pixels of an image, where the nearest hides the others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera

MIN_DEPTH = 0.5  # m along the optical axis; nearer points are not scored, 1/z would let them outweigh all others
Pixels = NDArray[np.intp]


def project(xyz: NDArray[np.float32], T: NDArray[np.float64], camera: Camera) -> tuple[Pixels, Pixels, Pixels]:
    """Points (n, 3) by T_camera_lidar (4, 4), eq. 2.30, on the nearest pixel of the pinhole `camera`.

    -> columns and rows (m,) of those in the image, and their indices into xyz (m,), ascending.
    """
    M = (camera.K @ T[:3]).astype(np.float32)
    p = M[:, :3] @ xyz.T + M[:, 3:]
    in_front = np.flatnonzero(p[2] > MIN_DEPTH)
    z = p[2, in_front]
    u, v = np.rint(p[0, in_front] / z), np.rint(p[1, in_front] / z)
    inside = np.flatnonzero((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
    return u[inside].astype(np.intp), v[inside].astype(np.intp), in_front[inside]


def nearest_per_pixel(pixels: Pixels, points: Pixels, size: int) -> tuple[Pixels, Pixels]:
    """Flat pixels (m,) of points (m,), far ones first -> each pixel once with its last, that is nearest, point."""
    top = np.empty(size, np.intp)
    top[pixels] = np.arange(len(pixels))  # of repeated indices the last is written
    shown = np.flatnonzero(top[pixels] == np.arange(len(pixels)))
    return pixels[shown], points[shown]


def near_image(xyz: NDArray[np.float32], T: NDArray[np.float64], camera: Camera, margin: float) -> Pixels:
    """Indices of the points (n, 3) that project into the image or within margin * width around it, in front of the camera."""
    P = xyz @ T[:3, :3].T + T[:3, 3]
    z, K, border = np.maximum(P[:, 2], 1e-6), camera.K, margin * camera.width
    u, v = K[0, 0] * P[:, 0] / z + K[0, 2], K[1, 1] * P[:, 1] / z + K[1, 2]
    inside = (u > -border) & (u < camera.width + border) & (v > -border) & (v < camera.height + border)
    return np.flatnonzero((P[:, 2] > MIN_DEPTH) & inside)

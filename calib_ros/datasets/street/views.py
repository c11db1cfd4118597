"""The rays of the camera through the synthetic street, and the windows that solids cover in its and the LiDAR's grid."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.datasets.street.rays import Jobs, Rays
from calib_ros.datasets.street.solids import Solids

Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]
Ints = NDArray[np.int32]

NEAR = 0.1  # m; solids are cut at this depth before they are projected
SMALLEST = 0.3  # of a pixel or firing step: smaller solids are left out


def pixel_directions(camera: Camera) -> tuple[Float32, Float32, NDArray[np.bool_]]:
    """Directions (x/z, y/z) through the pixel centres, each (H, W), and whether the lens sees that pixel (H, W).

    A pixel's centre is at integer coordinates, as in Camera.project. Where a distortion polynomial has no inverse the
    lens sees nothing, as in the black corners of real wide-angle images.
    """
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    uv = np.stack([u, v], -1).reshape(-1, 1, 2)
    if camera.is_pinhole:
        rays = (uv - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    else:
        # OpenCV's default of a few iterations is off by tenths of a pixel at the border of a strong lens.
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-9)
        rays = _undistort(camera.model)(uv, camera.K, camera.D, None, None, criteria)
    rays = np.nan_to_num(np.asarray(rays).reshape(-1, 2), nan=1e3, posinf=1e3, neginf=-1e3)
    back, _ = camera.project(np.c_[rays, np.ones(len(rays))])
    seen = (np.abs(back - uv.reshape(-1, 2)) < 0.01).all(axis=1).reshape(u.shape)
    x, y = (np.where(seen, rays[:, k].reshape(u.shape), 0).astype(np.float32) for k in (0, 1))
    return x, y, seen


def _undistort(model: str) -> Any:
    """OpenCV's inverse of a distortion model: (uv, K, D, R, P, criteria) -> directions."""
    if model == "equidistant":
        return lambda uv, K, D, R, P, criteria: cv2.fisheye.undistortPoints(uv, K, D, R=R, P=P, criteria=criteria)
    # OpenCV 4 has a function of its own for a choice of iterations, 5 has an argument.
    if hasattr(cv2, "undistortPointsIter"):
        return cv2.undistortPointsIter
    return lambda uv, K, D, R, P, criteria: cv2.undistortPoints(uv, K, D, R=R, P=P, criteria=criteria)


def towards(R: Floats, x: Float32, y: Float32) -> tuple[Float32, Float32, Float32]:
    """Directions (x, y, 1) of the camera turned by R (3, 3) into the world: x, y and z parts."""
    M = R.astype(np.float32)
    return (M[0, 0] * x + M[0, 1] * y + M[0, 2], M[1, 0] * x + M[1, 1] * y + M[1, 2], M[2, 0] * x + M[2, 1] * y + M[2, 2])


def nearest_first(window: Ints, nearest: Floats) -> Jobs:
    order = np.argsort(nearest, kind="stable")
    return Jobs(window[order], nearest[order])


class CameraView:
    """All pixels of a camera. Coordinates of solids and rays are world axes with the origin at the lens."""

    def __init__(self, camera: Camera) -> None:
        self.x, self.y, self.seen = pixel_directions(camera)
        # Change of the direction per pixel down (0) and to the right (1), for rays between the pixels' centres.
        self.dx, self.dy = np.gradient(self.x), np.gradient(self.y)
        self._columns = self._limits(self.x, 0)
        self._rows = self._limits(self.y, 1)
        self._smallest = SMALLEST / max(camera.K[0, 0], camera.K[1, 1])

    def _limits(self, a: Float32, axis: int) -> tuple[Floats, Floats]:
        """Lowest and highest direction in each column (axis 0) or row (axis 1) of the seen pixels."""
        low = np.where(self.seen, a, np.inf).min(axis=axis)
        high = np.where(self.seen, a, -np.inf).max(axis=axis)
        return low.astype(float), high.astype(float)

    def rays(self, R_world_camera: Floats) -> Rays:
        """The rays with their depth as distance: directions have z = 1 in the camera."""
        zero = np.zeros((1, 1), np.float32)
        return Rays((zero, zero, zero), towards(R_world_camera, self.x, self.y))

    def jobs(self, solids: Solids, R_world_camera: Floats) -> Jobs:
        """Windows for `cast`."""
        corners = solids.corners() @ R_world_camera
        edges = np.array([(a, a | 1 << b) for a in range(8) for b in range(3) if not a >> b & 1])
        p, q = corners[:, edges[:, 0]], corners[:, edges[:, 1]]
        depth = q[..., 2] - p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            cut = p + (q - p) * ((NEAR - p[..., 2]) / depth)[..., None]
            crosses = (p[..., 2] < NEAR) != (q[..., 2] < NEAR)
            points = np.concatenate([corners, cut], axis=1)
            valid = np.concatenate([corners[..., 2] >= NEAR, crosses], axis=1)
            low = [np.where(valid, points[..., k] / points[..., 2], np.inf).min(axis=1) for k in (0, 1)]
            high = [np.where(valid, points[..., k] / points[..., 2], -np.inf).max(axis=1) for k in (0, 1)]
        keep = valid.any(axis=1) & (high[0] - low[0] > self._smallest) & (high[1] - low[1] > self._smallest)
        spans = []
        for (first, last), lo, hi in ((self._rows, low[1], high[1]), (self._columns, low[0], high[0])):
            inside = (last >= lo[:, None]) & (first <= hi[:, None])
            spans += [inside.argmax(axis=1), inside.shape[1] - inside[:, ::-1].argmax(axis=1)]
            keep &= inside.any(axis=1)
        nearest = np.where(valid, points[..., 2], np.inf).min(axis=1)
        jobs = np.stack([np.arange(len(solids)), *spans], axis=1).astype(np.int32)[keep]
        return nearest_first(jobs, nearest[keep])


def lidar_jobs(solids: Solids, elevation: Floats, firings: int, yaw: float, margin: tuple[float, float, float]) -> Jobs:
    """Windows for `cast` in a grid of rings (from the top) x firings, whose azimuth rises from -pi to pi.

    Solids are in world axes with the origin at the scanner. elevation: (rings,) rad. yaw: of the scanner in rad.
    margin: how far the scanner's origin (m), its azimuth (rad) and its elevation (rad) may be from that in the scan.
    """
    shift, turn, tilt = margin
    corners = solids.corners()
    azimuth = np.arctan2(corners[..., 1], corners[..., 0])
    centre = np.arctan2(solids.centre[:, 1], solids.centre[:, 0])
    spread = np.mod(azimuth - centre[:, None] + np.pi, 2 * np.pi) - np.pi
    # The scanner in the frame of the solid tells the distance to its footprint.
    c, s = np.cos(solids.yaw), np.sin(solids.yaw)
    x, y = solids.centre[:, 0], solids.centre[:, 1]
    beside = np.maximum(np.abs(np.stack([c * x + s * y, c * y - s * x])) - solids.half[:, :2].T, 0)
    near = np.maximum(np.hypot(*beside) - shift, 0.1)
    far = np.hypot(corners[..., 0], corners[..., 1]).max(axis=1) + shift
    low, high = solids.centre[:, 2] - solids.half[:, 2], solids.centre[:, 2] + solids.half[:, 2]
    top = np.arctan2(high, np.where(high > 0, near, far)) + tilt
    bottom = np.arctan2(low, np.where(low < 0, near, far)) - tilt
    side = np.arcsin(np.minimum(shift / near, 1)) + turn
    around = near < 0.5
    left = np.where(around, np.pi, spread.max(axis=1) + side)
    right = np.where(around, -np.pi, spread.min(axis=1) - side)
    step = 2 * np.pi / firings
    r0 = np.searchsorted(-elevation, -top)
    r1 = np.searchsorted(-elevation, -bottom, side="right")
    middle = np.mod(centre - yaw + np.pi, 2 * np.pi)
    c0 = np.floor((middle + right) / step).astype(int)
    c1 = np.minimum(np.ceil((middle + left) / step).astype(int) + 1, c0 + firings)
    keep = np.flatnonzero((r1 > r0) & (left - right - 2 * side > SMALLEST * step))
    jobs = []
    for i in keep.tolist():
        # A window that leaves the grid on one side comes in again on the other.
        for k in (-firings, 0, firings):
            a, b = max(c0[i] + k, 0), min(c1[i] + k, firings)
            if b > a:
                jobs.append((i, r0[i], r1[i], a, b))
    window = np.array(jobs, np.int32).reshape(-1, 5)
    return nearest_first(window, near[window[:, 0]])

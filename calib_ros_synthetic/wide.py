"""The pixels of a fisheye that may look behind itself: directions are unit vectors, and distances are along them."""

from __future__ import annotations

import numpy as np

from calib_ros.camera import Camera
from calib_ros.lens import LensProjection
from calib_ros_synthetic.rays import SMALLEST, CameraView, Jobs, RowMotion, Vectors, nearest_first
from calib_ros_synthetic.solids import Float32, Floats, Solids

STEPS = 8  # parts of each edge of a solid's box whose ends are projected
BEHIND = np.deg2rad(150.0)  # from the axis; what reaches further may wrap around the picture
_CORNERS = np.array([(a, a | 1 << b) for a in range(8) for b in range(3) if not a >> b & 1])


class WideView(CameraView):
    """All pixels of a lens with a field of up to 200 deg or so; beyond it the picture is black."""

    def __init__(self, camera: Camera, field: float) -> None:
        """camera: of a wide model. field: degrees across, of the circle that the lens images."""
        self.K = camera.K
        self._lens = LensProjection(camera.model, camera.D)
        self._field = np.deg2rad(field / 2)
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        rays = self._lens.rays(((pixels - self.K[:2, 2]) / np.diag(self.K)[:2]).reshape(-1, 2)).reshape((*pixels.shape[:2], 3))
        self.seen = rays[..., 2] >= np.cos(self._field)
        # What the lens does not show is behind it.
        rays[np.isnan(rays[..., 2])] = 0, 0, -1
        self.x, self.y, self.z = np.moveaxis(rays.astype(np.float32), -1, 0)
        self.dx, self.dy, self.dz = np.gradient(self.x), np.gradient(self.y), np.gradient(self.z)

    def _image(self, x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
        """Columns, rows (px) and angles from the axis (rad) of points at x, y, z in the camera's frame; of those beyond what the
        lens shows, as if they were at its limit."""
        flat = np.hypot(x, y)
        angle = np.arctan2(flat, z)
        shown = np.minimum(angle, (1 - 1e-9) * self._lens.limit)
        across = np.sin(shown) / np.maximum(flat, 1e-12)
        xy = self._lens.image(np.stack([x * across, y * across, np.cos(shown)], axis=-1).reshape(-1, 3)).reshape((*x.shape, 2))
        return self.K[0, 0] * xy[..., 0] + self.K[0, 2], self.K[1, 1] * xy[..., 1] + self.K[1, 2], angle

    def pixels(self, points: Vectors) -> Float32:
        """Where points (x, y, z parts of any shape) in the camera's frame are in the picture -> (..., 2) px."""
        u, v, _ = self._image(*(a.astype(float) for a in points))
        return np.stack([u, v], axis=-1).astype(np.float32)

    def jobs(self, solids: Solids, R_world_camera: Floats, motion: RowMotion | None = None) -> Jobs:
        """Windows for `cast`: the picture of a box is bounded by those of its edges."""
        shift, turn = (motion.shift, motion.turn) if motion is not None else (0.0, 0.0)
        height, width = self.x.shape
        corners = solids.corners()
        c, s = np.cos(solids.yaw), np.sin(solids.yaw)
        x, y, z = solids.centre.T
        outside = np.stack([np.abs(c * x + s * y), np.abs(c * y - s * x), np.abs(z)], axis=1) - solids.half - shift
        nearest = np.linalg.norm(np.maximum(outside, 0), axis=1)
        corners = corners @ R_world_camera
        p, q = corners[:, _CORNERS[:, 0]], corners[:, _CORNERS[:, 1]]
        t = np.linspace(0, 1, STEPS + 1)[:, None]
        points = p[:, :, None] + (q - p)[:, :, None] * t  # (n, 12, STEPS + 1, 3)
        u, v, angle = self._image(points[..., 0], points[..., 1], points[..., 2])
        unit = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
        # Between the ends a straight edge is a bow: its height is at most the square of the angle it spans.
        span = np.linalg.norm(np.diff(unit, axis=2), axis=-1).max(axis=(1, 2))
        moved = np.arcsin(np.minimum(shift / np.maximum(nearest, 1e-3), 1)) + 2 * turn
        slack = max(self.K[0, 0], self.K[1, 1]) * (0.3 * span**2 + moved) + 1
        low_u, high_u = u.min(axis=(1, 2)), u.max(axis=(1, 2))
        low_v, high_v = v.min(axis=(1, 2)), v.max(axis=(1, 2))
        keep = angle.min(axis=(1, 2)) - span - moved < self._field
        keep &= np.maximum(high_u - low_u, high_v - low_v) > SMALLEST
        around = (nearest < 0.3) | (angle.max(axis=(1, 2)) > BEHIND) | (span > 0.5)
        spans = []
        for low, high, size in ((low_v, high_v, height), (low_u, high_u, width)):
            first, past = np.floor(low - slack), np.ceil(high + slack) + 1
            spans += [np.where(around, 0, np.clip(first, 0, size)), np.where(around, size, np.clip(past, 0, size))]
        keep &= (spans[1] > spans[0]) & (spans[3] > spans[2])
        jobs = np.stack([np.arange(len(solids)), *spans], axis=1).astype(np.int32)[keep]
        return nearest_first(jobs, nearest[keep])

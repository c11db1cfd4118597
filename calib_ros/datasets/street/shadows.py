"""Which places of the synthetic street the sun reaches: a depth map seen by the sun. Only the camera has use for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.street.rays import SKY, Ints, Jobs, Rays, cast
from calib_ros.datasets.street.solids import Float32, Floats, Solids
from calib_ros.datasets.street.views import nearest_first

AHEAD, SIDE, TEXEL = 55.0, 13.0, 0.07  # m that the map reaches ahead and to either side; m per texel


class SunView:
    """Parallel rays from the sun on a grid of texels that covers given points, so that shadows can be looked up."""

    def __init__(self, sun: Floats, receivers: Floats, texel: float) -> None:
        """sun: unit vector towards it (3,). receivers: (n, 3) metres, to be covered. texel: metres."""
        e1 = np.cross([0.0, 0.0, 1.0], sun)
        e1 /= np.linalg.norm(e1)
        self.axes = np.stack([e1, np.cross(sun, e1), -sun])  # columns, rows, distance from the sun
        flat = receivers @ self.axes.T
        self.texel = texel
        self.low = flat.min(axis=0)
        self.low[2] -= 60.0  # far enough towards the sun to start outside everything that throws shadows
        self.shape = tuple(int(n) for n in np.ceil((flat.max(axis=0) - self.low)[1::-1] / texel) + 1)

    def rays(self) -> Rays:
        """The rays; their distance starts at `low`."""
        rows = (self.low[1] + np.arange(self.shape[0]) * self.texel)[:, None]
        columns = (self.low[0] + np.arange(self.shape[1]) * self.texel)[None]
        e1, e2, down = self.axes
        origin = tuple((e1[k] * columns + e2[k] * rows + down[k] * self.low[2]).astype(np.float32) for k in range(3))
        direction = tuple(np.full((1, 1), v, np.float32) for v in down)
        return Rays(origin, direction)  # type: ignore[arg-type]

    def jobs(self, solids: Solids) -> Jobs:
        """Windows for `cast`."""
        flat = solids.corners() @ self.axes.T
        low, high = flat.min(axis=1), flat.max(axis=1)
        spans = []
        for k in (1, 0):
            spans += [np.ceil((low[:, k] - self.low[k]) / self.texel), np.floor((high[:, k] - self.low[k]) / self.texel) + 1]
        size = np.array([self.shape[0], self.shape[0], self.shape[1], self.shape[1]])[:, None]
        clipped = np.clip(np.array(spans), 0, size).astype(np.int32)
        keep = (clipped[1] > clipped[0]) & (clipped[3] > clipped[2]) & (low[:, 2] > self.low[2])
        jobs = np.concatenate([np.arange(len(solids), dtype=np.int32)[None], clipped])[:, keep].T
        return nearest_first(np.ascontiguousarray(jobs), low[keep, 2] - self.low[2])


class Shadows:
    """Looks up which places the sun reaches."""

    def __init__(self, solids: Solids, sun: Floats, forward: Floats, height: float) -> None:
        """solids: relative to the lens. sun, forward: towards the sun and along the view (3,). height: of the lens, m."""
        forward = forward[:2] / (np.linalg.norm(forward[:2]) + 1e-9)
        left = np.array([-forward[1], forward[0]])
        box = [[*(a * forward + b * left), z] for a in (0.0, AHEAD) for b in (-SIDE, SIDE) for z in (-height, 5.0)]
        self._view = SunView(sun, np.array(box), TEXEL)
        rays = self._view.rays()
        self._depth = np.full(self._view.shape, np.inf, np.float32)
        self._ids = np.full(self._view.shape, SKY, np.int32)
        cast(rays, solids, self._view.jobs(solids), self._depth, self._ids)
        d = self._depth
        d = np.minimum(d, np.roll(d, -1, axis=1))
        self._first = np.minimum(d, np.roll(d, -1, axis=0))  # of the four texels around a place

    def lit(self, xyz: Float32, ids: Ints, faces_sun: NDArray[np.bool_]) -> Float32:
        """Share (n,) of the sun that reaches points xyz (3, n) on the things ids (n,); 1 outside the map.

        Only places that face the sun (n,) are looked up. A solid does not shade itself here: its normals tell that,
        without the speckles of a depth map.
        """
        axes, low, scale = self._view.axes.tolist(), self._view.low.tolist(), 1 / self._view.texel
        height, width = self._depth.shape
        some = np.flatnonzero(faces_sun)
        x, y, z = (xyz[k].take(some) for k in range(3))
        columns, rows = (((axes[k][0] * x + axes[k][1] * y + axes[k][2] * z) - low[k]) * scale for k in (0, 1))
        depth = (axes[2][0] * x + axes[2][1] * y + axes[2][2] * z) - (low[2] + 0.03)
        inside = (columns >= 0) & (columns < width - 1) & (rows >= 0) & (rows < height - 1)
        texel = np.where(inside, rows, 0).astype(np.int32) * width + np.where(inside, columns, 0).astype(np.int32)
        hidden = np.flatnonzero(inside & (self._first.ravel().take(texel) < depth))
        columns, rows, depth, texel = columns[hidden], rows[hidden], depth[hidden], texel[hidden]
        some = some[hidden]
        a, b, own = columns % 1, rows % 1, ids[some]
        shade = np.zeros(len(some), np.float32)
        for step, weight in ((0, (1 - b) * (1 - a)), (1, (1 - b) * a), (width, b * (1 - a)), (width + 1, b * a)):
            at = texel + step
            shade += weight * ((self._depth.ravel().take(at) < depth) & (self._ids.ravel().take(at) != own))
        out = np.ones(len(ids), np.float32)
        out[some] -= shade
        return out

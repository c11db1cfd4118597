"""Depth discontinuity along the rings (thesis 3.4.3, eq. 3.10; Levinson and Thrun 2013)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import PointCloud
from calib_ros.lidar.rings import ring_of_points

# rad; across a wider gap, and one three times wider than usual, the field of view ends, and its ends are no neighbours.
NEIGHBOURHOOD = float(np.deg2rad(60.0))


def discontinuity(cloud: PointCloud) -> NDArray[np.float32]:
    """xi (n,) in m of every point, eq. 3.10: how much farther than it the farther one of its neighbours in the ring lies.

    Neighbours are the returns next to it by azimuth; rings close upon themselves if the sensor turns all the way round. The
    cloud must be finite. Rings are the source's own, or found from the points. A point alone in its ring has 0.
    """
    xyz = cloud.xyz
    if len(xyz) == 0:
        return np.empty(0, np.float32)
    q = np.linalg.norm(xyz, axis=1).astype(np.float32)
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0])
    ring = ring_of_points(cloud, azimuth, np.arcsin(xyz[:, 2] / np.maximum(q, 1e-6)))
    order = np.lexsort((azimuth, ring))
    ring, along = ring[order], q[order]
    starts = np.flatnonzero(np.diff(ring, prepend=ring[0] - 1))
    ends = np.append(starts[1:], len(ring)) - 1
    before, after = np.roll(along, 1), np.roll(along, -1)
    before[starts], after[ends] = along[ends], along[starts]
    turn = azimuth[order]
    last, following = np.roll(turn, 1), np.roll(turn, -1)
    last[starts], following[ends] = turn[ends], turn[starts]
    gap_before, gap_after = _gap(turn, last), _gap(turn, following)
    limit = max(NEIGHBOURHOOD, 3 * float(np.median(gap_after)))
    before[gap_before > limit] = 0
    after[gap_after > limit] = 0
    xi = np.empty(len(q), np.float32)
    xi[order] = np.maximum(np.maximum(before, after) - along, 0)
    return xi


def _gap(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.floating]:
    """Angles between azimuths, 0..pi rad."""
    gap = np.abs(a - b)
    return np.minimum(gap, 2 * np.pi - gap)

"""Depth discontinuity along the rings (thesis 3.4.3, eq. 3.10; Levinson and Thrun 2013)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import PointCloud
from calib_ros.lidar.rings import ring_of_points


def discontinuity(cloud: PointCloud) -> NDArray[np.float32]:
    """xi (n,) in m of every point, eq. 3.10: how much farther than it the farther one of its neighbours in the ring lies.

    Neighbours are the returns next to it by azimuth; rings close upon themselves. The cloud must be finite. Rings are the
    source's own, or found from the points. A point alone in its ring has 0.
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
    xi = np.empty(len(q), np.float32)
    xi[order] = np.maximum(np.maximum(before, after) - along, 0)
    return xi

"""What is at a point of the synthetic street: its normal and its material, the same for the camera and the LiDAR."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.street.blocks import Street
from calib_ros.datasets.street.parts import PAINTERS, PLAIN_PARTS, Bytes, Place, ground_parts
from calib_ros.datasets.street.rays import CURB, ROAD
from calib_ros.datasets.street.solids import Float32, Floats, Kind, Solids


@dataclass(frozen=True, eq=False)
class Spots:
    """n hits. normal: (3, n) unit vectors in world axes. u, v: (n,) metres along and up the surface. part: (n,) Part."""

    part: Bytes
    normal: Float32
    u: Float32
    v: Float32


def spots(street: Street, solids: Solids, ids: NDArray[np.int32], xyz: Float32, origin: Floats) -> Spots:
    """Materials of hits: ids (n,) as `cast` writes them, xyz (3, n) relative to origin (3,) in the world."""
    n = len(ids)
    out = Spots(np.zeros(n, np.uint8), np.zeros((3, n), np.float32), np.zeros(n, np.float32), np.zeros(n, np.float32))
    out.normal[2] = 1
    ground = np.flatnonzero(ids <= ROAD)
    if len(ground):
        s, d = street.path.frenet(xyz[0, ground], xyz[1, ground], origin)
        out.u[ground], out.v[ground] = s, d
        out.part[ground] = ground_parts(street, ids[ground], s, d)
        curb = ground[ids[ground] == CURB]
        heading = street.path.station(out.u[curb])[2]
        towards_road = -np.sign(out.v[curb])
        out.normal[:, curb] = [-np.sin(heading) * towards_road, np.cos(heading) * towards_road, np.zeros(len(curb))]
    body = np.flatnonzero(ids >= 0)
    if len(body):
        _bodies(solids, ids[body], xyz[:, body], out, body)
    return out


def _bodies(solids: Solids, ids: NDArray[np.int32], xyz: Float32, out: Spots, where: NDArray[np.intp]) -> None:
    def of(values: NDArray[np.float64]) -> Float32:
        return np.asarray(values.astype(np.float32).take(ids))

    c, s = of(np.cos(solids.yaw)), of(np.sin(solids.yaw))
    x, y, z = (xyz[k] - of(solids.centre[:, k]) for k in range(3))
    half = [of(solids.half[:, k]) for k in range(3)]
    q = np.stack([(c * x + s * y) / half[0], (c * y - s * x) / half[1], z / half[2]])  # -1..1 in the solid's own axes
    # The sides of a frustum lean; a box is a frustum that does not.
    slope = [of(solids.taper[:, k] / 2) for k in (0, 1)]
    side = [np.abs(q[k]) + slope[k] * (q[2] + 1) for k in (0, 1)]
    top = np.abs(q[2])
    across = (side[0] >= side[1]) & (side[0] >= top)
    along = ~across & (side[1] >= top)
    face = np.where(across, np.uint8(0), np.where(along, np.uint8(1), np.uint8(2)))
    normal = [
        np.where(across, np.sign(q[0]), 0),
        np.where(along, np.sign(q[1]), 0),
        np.where(across, slope[0], np.where(along, slope[1], np.sign(q[2]))),
    ]
    curved = np.flatnonzero(solids.kind.take(ids) >= Kind.ELLIPSOID)
    kind, bent = solids.kind[ids[curved]], q[:, curved]
    for shape, k in ((Kind.CYLINDER, 2), (Kind.WHEEL, 1)):
        m = kind == shape
        cap = m & (np.abs(bent[k]) > 0.999)
        for j in range(3):
            bent[j] = np.where(cap, np.sign(bent[k]) if j == k else 0, np.where(m & (j == k), 0, bent[j]))
    for k in range(3):
        normal[k][curved] = bent[k]
        normal[k] /= half[k]
    scale = 1 / np.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    out.normal[0, where] = (c * normal[0] - s * normal[1]) * scale
    out.normal[1, where] = (s * normal[0] + c * normal[1]) * scale
    out.normal[2, where] = normal[2] * scale
    u = np.where(across, q[1] * half[1], q[0] * half[0])
    v = np.where(face == 2, q[1] * half[1], (q[2] + 1) * half[2])
    out.u[where], out.v[where] = u, v
    surface = solids.surface[ids]
    part = np.zeros(len(ids), np.uint8)
    for code in np.unique(surface).tolist():
        if code in PLAIN_PARTS:
            part[surface == code] = PLAIN_PARTS[code]
            continue
        m = np.flatnonzero(surface == code)
        at = Place(q[:, m], face[m], u[m], v[m], np.ascontiguousarray(solids.style[ids[m]].T))
        part[m] = PAINTERS[code](at)
    out.part[where] = part

"""Where the scanner sits in the frame of its cloud: its centre and its spin axis, found from the scan or given.

Clouds may come in the frame of the vehicle, or from a scanner that is tilted or upside down. Neighbouring rays, and with them
edges, are known only in the scanner's own frame: there every laser sweeps a cone about the spin axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix as Floats
from calib_ros.lidar.segmentation import fit_ground, neighbours_of
from calib_ros.se3 import skew

# Points of the two rounds of the fit, the first by far ones: errors are below 0.02 deg and 1 cm on all scanners tried.
FIRST_POINTS, FIT_POINTS = 1000, 4000
PAIR_POINTS, NEIGHBOURS = 1500, 4
# Share to which a pose must lower the differences of neighbours: right ones 0.02 to 0.1, wrong ones 0.25 and more.
MUCH_ALIKE = 0.15
# The search for a ground above: points at most so far away, number of them, their least height, a plane's share of them, and
# what the best plane below may hold of it. On 18 rigs and 7 vehicles the ground holds 0.14 to 0.69, planes opposite 0.01 to 0.11.
NEAR_GROUND, GROUND_POINTS, MIN_HEIGHT, GROUND_SHARE, MAX_BELOW = 20.0, 1500, 0.2, 0.13, 0.55
GROUND_THICKNESS, GROUND_PLANES, MAX_SLOPE_DEG = 0.15, 64, 35.0  # m; planes tried; deg, also the tilt of the scanner
CONE_POINTS = 40_000  # points that are enough for the cones of all rings
FIT_STEPS = 25
NEAR_M, NEAR_DEG = 0.5, 0.5  # of the cloud's frame
FIT_DONE, NEAR_DONE = 1e-5, 1e-3  # rad and m; a smaller step ends the fit, and one that only tells near from far
CENTRE_SIGMA, MAX_CENTRE = 3.0, 8.0  # m; how far from the origin a scanner may be: what the scan leaves open, and the limit
MAX_STEP_M, MAX_STEP_RAD = 1.0, 0.3  # of one step of the fit
MIN_SCALE = 1e-4  # rad; no laser is pointed better
CAUCHY = 2.5  # residuals beyond this multiple of their scale fade
MAD_TO_SIGMA = 1.4826
STARTS = ((2, 0.0), (2, 2.0), (0, 0.0), (1, 0.0))  # of the fit: axis x, y or z (0, 1, 2), and height along z in m
RINGS_APART = 0.3  # spread of rings as a share of their spacing: de-skewed HDL-64E 0.24, evenly scattered points 0.37
APEX_SIGMA, HEIGHT_SIGMA = 0.15, 0.02  # m; spread of apex heights about the centre, and of points about their cone


@dataclass(frozen=True, eq=False)
class ScannerPose:
    """Pose of the scanner in the frame of its cloud. centre : (3,) m, where the rays meet. rotation : (3, 3), T_cloud_scanner's
    rotation; its last column is the spin axis."""

    centre: Floats = field(default_factory=lambda: np.zeros(3))
    rotation: Floats = field(default_factory=lambda: np.eye(3))

    @staticmethod
    def given(position_m: Sequence[float], rpy_deg: Sequence[float]) -> ScannerPose:
        """Position (3,) in m, and roll, pitch, yaw (3,) in deg about fixed x, y, z, as in URDF and TF."""
        return ScannerPose(np.array(position_m, float), se3.rotation_from_euler(*np.deg2rad(rpy_deg)[::-1]))

    @property
    def is_cloud_frame(self) -> bool:
        """Whether the cloud is given in the scanner's own frame."""
        return not self.centre.any() and bool((self.rotation == np.eye(3)).all())

    @property
    def axis(self) -> Floats:
        """Spin axis (3,) in the cloud's frame, towards the rings that count as upper ones."""
        return self.rotation[:, 2]

    @property
    def tilt_deg(self) -> float:
        """Angle between the spin axis and the z axis of the cloud, 0..180 deg; beyond 90 the scanner hangs upside down."""
        return float(np.rad2deg(np.arctan2(np.hypot(*self.axis[:2]), self.axis[2])))

    def turned_over(self) -> ScannerPose:
        """The same with the axis the other way: the upper rings of a scanner that hangs upside down are those that look up."""
        return ScannerPose(self.centre, self.rotation * np.array([1.0, -1.0, -1.0]))

    def to_scanner(self, xyz: NDArray[np.floating]) -> NDArray[np.floating]:
        """Points (n, 3) of the cloud in the scanner's frame; the array itself where the two are the same."""
        if self.is_cloud_frame:
            return xyz
        return np.asarray((xyz - self.centre.astype(xyz.dtype)) @ self.rotation.astype(xyz.dtype))

    def to_cloud(self, xyz: NDArray[np.floating]) -> NDArray[np.floating]:
        """Points (n, 3) of the scanner's frame in that of the cloud."""
        return xyz if self.is_cloud_frame else np.asarray(xyz @ self.rotation.T + self.centre)


CLOUD_FRAME = ScannerPose()


@dataclass(frozen=True)
class RingFit:
    """A pose, and how well the rings are cones about its axis. spread: rad, robust deviation of the points from the cone of their
    ring. spacing: rad, median step between neighbouring rings."""

    pose: ScannerPose
    spread: float
    spacing: float

    @property
    def apart(self) -> bool:
        """Whether the rings lie apart."""
        return self.spread <= RINGS_APART * self.spacing


def ring_fit(xyz: NDArray[np.floating], ring: NDArray[np.int32], pose: ScannerPose = CLOUD_FRAME) -> RingFit:
    """How well the rings (n,) of points (n, 3) are cones as seen from `pose`."""
    return _measured(*_sample(xyz, ring, FIT_POINTS), pose)


def fitted_pose(xyz: NDArray[np.floating], ring: NDArray[np.int32], start: ScannerPose | None = None) -> RingFit:
    """The pose at which every ring (n,) of the points (n, 3) is a cone about the spin axis, which points to the cloud's z.

    Robust Gauss-Newton on the elevation, from several axes and heights; along directions that the scan does not show the centre
    stays near the origin. start: a pose that is near, if one is known.
    """
    P, row = _sample(xyz, ring, 2 * FIRST_POINTS)
    # A centre that is metres off turns the elevations of the nearest half by tens of degrees: the fit would have local optima.
    distance = np.linalg.norm(P, axis=1)
    far = distance >= np.median(distance)
    P, row = P[far], np.unique(row[far], return_inverse=True)[1].astype(np.intp).ravel()
    starts = [ScannerPose(height * np.eye(3)[2], upright(np.eye(3)[axis])) for axis, height in STARTS]
    best: RingFit | None = None
    for begin in starts if start is None else [start]:
        fit = _measured(P, row, _gauss_newton(P, row, begin))
        if best is None or fit.spread < best.spread:
            best = fit
        if best.apart:
            break
    assert best is not None
    P, row = _sample(xyz, ring, FIT_POINTS)
    return _measured(P, row, _upward(_gauss_newton(P, row, best.pose)))


def pose_by_neighbours(xyz: NDArray[np.floating]) -> ScannerPose | None:
    """The pose at which neighbouring points of (n, 3) have the same elevation, without knowing any ring; None if there is none.
    Good to 0.2 deg and 0.2 m, from which rings can be told apart and fitted."""
    # Points are denser along rings than across: most of a point's neighbours are of its ring, of the rest half are above.
    tree = neighbours_of(xyz, balanced_tree=False, compact_nodes=False)
    some = np.arange(0, len(xyz), max(len(xyz) // PAIR_POINTS, 1) | 1)
    near = tree.query(xyz[some], np.arange(2, 2 + NEIGHBOURS))[1]
    P = np.concatenate([np.repeat(xyz[some], NEIGHBOURS, axis=0), xyz[near.ravel()]]).astype(np.float64)
    limit = MUCH_ALIKE * _unlikeness(P, CLOUD_FRAME)
    for axis in np.eye(3)[[2, 0, 1]]:
        pose = _gauss_newton(P, None, ScannerPose(rotation=upright(axis)))
        if _unlikeness(P, pose) < limit and np.abs(pose.centre).max() < MAX_CENTRE:
            return _upward(pose)
    return None


def _unlikeness(P: Floats, pose: ScannerPose) -> float:
    """Median difference of the elevations of pairs of points, rad, as seen from a pose."""
    own = pose.to_scanner(P)
    return float(np.median(np.abs(_against(None, np.arctan2(own[:, 2], np.hypot(own[:, 0], own[:, 1]))))))


def hangs_upside_down(xyz: NDArray[np.floating]) -> bool:
    """Whether the ground is above: a plane with most of the near points (n, 3) in the scanner's frame, and no such one below."""
    near = xyz[:: max(len(xyz) // (4 * GROUND_POINTS), 1) | 1]
    near = near[np.einsum("ij,ij->i", near, near) < NEAR_GROUND**2]
    if np.count_nonzero(near[:, 2] > 0) <= len(near) / 2:
        return False
    some = near[:: max(len(near) // GROUND_POINTS, 1)]
    shares = []  # of the points in the horizontal plane with the most of them, above and below
    for side in (1, -1):
        part = some[side * some[:, 2] > MIN_HEIGHT]
        plane = fit_ground(part.astype(np.float32), GROUND_THICKNESS, GROUND_PLANES, MAX_SLOPE_DEG, 0.0, 0)
        inside = 0 if plane is None else np.count_nonzero(np.abs(plane.distance(part)) < GROUND_THICKNESS)
        shares.append(inside / max(len(some), 1))
    return shares[0] > GROUND_SHARE and shares[1] < MAX_BELOW * shares[0]


def _upward(pose: ScannerPose) -> ScannerPose:
    return pose if pose.axis[2] >= 0 else ScannerPose(pose.centre, upright(-pose.axis))


def stays(xyz: NDArray[np.floating], ring: NDArray[np.int32], spread: float) -> bool:
    """Whether the fit of rings (n,) of points (n, 3) stays near the cloud's frame, with more than this spread: compensated scans
    are blurred, but not seen from elsewhere."""
    P, row = _sample(xyz, ring, FIRST_POINTS)
    fit = _measured(P, row, _gauss_newton(P, row, CLOUD_FRAME, NEAR_DONE))
    return bool(np.linalg.norm(fit.pose.centre) < NEAR_M and fit.pose.tilt_deg < NEAR_DEG and fit.spread > spread)


def ring_cones(row: NDArray[np.int32], xyz: NDArray[np.floating], rows: int) -> Floats:
    """Cone z = offset + slope * distance from the axis, fitted to the points (n, 3) of each row -> (rows, 2), offset m and slope.
    Its apex need not be the origin of the cloud: the lasers of an HDL-64E sit 0.12 m to 0.21 m above it."""
    every = max(len(row) // CONE_POINTS, 1) | 1
    if every > 1 and np.bincount(row[::every], minlength=rows).all():
        row, xyz = row[::every], xyz[::every]
    row = row.astype(np.intp)
    z = xyz[:, 2].astype(np.float64)
    rho = np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    weight = 1 / np.maximum(rho, 0.1)  # errors of tilted rays grow with the distance
    values = (weight, weight * rho, weight * rho * rho, weight * z, weight * rho * z)
    count, s_r, s_rr, s_z, s_rz = (np.bincount(row, value, rows) for value in values)
    n = np.asarray(count + (HEIGHT_SIGMA / APEX_SIGMA) ** 2)  # a ring at a single distance: apex at the origin
    determinant = np.maximum(n * s_rr - s_r**2, 1e-12)
    return np.stack([(s_z * s_rr - s_r * s_rz) / determinant, (n * s_rz - s_r * s_z) / determinant], axis=1)


def upright(axis: Floats) -> Floats:
    """The smallest rotation (3, 3) that takes the z axis to the unit vector `axis`, so that azimuths keep their zero."""
    z = np.array([0.0, 0.0, 1.0])
    v, c = np.cross(z, axis), float(axis[2])
    if c < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    V = skew(v)
    return np.asarray(np.eye(3) + V + V @ V / (1 + c))


def _sample(xyz: NDArray[np.floating], ring: NDArray[np.int32], points: int) -> tuple[Floats, NDArray[np.intp]]:
    """Points and compact ring numbers of about so many points, evenly over the scan."""
    every = max(len(xyz) // points, 1) | 1  # odd: a power of two would take the same lasers of every firing
    row = np.unique(ring[::every], return_inverse=True)[1]
    return xyz[::every].astype(np.float64), row.astype(np.intp).ravel()


def _gauss_newton(P: Floats, row: NDArray[np.intp] | None, start: ScannerPose, done: float = FIT_DONE) -> ScannerPose:
    """The pose at which the elevations of the points (n, 3) of each row are equal; without rows, of neighbours (`_against`)."""
    R, c = start.rotation, start.centre
    for _ in range(FIT_STEPS):
        u = (P - c) @ R
        rho = np.maximum(np.hypot(u[:, 0], u[:, 1]), 1e-6)
        square = rho * rho + u[:, 2] ** 2
        elevation = np.arctan2(u[:, 2], rho)
        gradient = np.stack([-u[:, 2] * u[:, 0] / rho, -u[:, 2] * u[:, 1] / rho, rho], axis=1) / square[:, None]
        J = np.empty((len(P), 5))  # by the centre, and by rotations about the scanner's x and y
        J[:, :3] = -gradient @ R.T
        J[:, 3] = gradient[:, 1] * u[:, 2] - gradient[:, 2] * u[:, 1]
        J[:, 4] = gradient[:, 2] * u[:, 0] - gradient[:, 0] * u[:, 2]
        residual = _against(row, elevation)
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), MIN_SCALE)
        weight = 1 / (1 + (residual / (CAUCHY * scale)) ** 2)
        residual, *columns = (_against(row, values, weight) for values in (elevation, *J.T))
        J = np.stack(columns, axis=1)
        prior = np.diag(np.r_[np.full(3, (scale / CENTRE_SIGMA) ** 2), np.full(2, 1e-9)])
        weighted = J * weight[:, None]
        step = -np.linalg.solve(weighted.T @ J + prior, weighted.T @ residual + prior @ np.r_[c, 0, 0])
        step[:3] *= min(1.0, MAX_STEP_M / max(float(np.linalg.norm(step[:3])), 1e-9))
        step[3:] *= min(1.0, MAX_STEP_RAD / max(float(np.linalg.norm(step[3:])), 1e-9))
        c = np.clip(c + step[:3], -MAX_CENTRE, MAX_CENTRE)
        axis = R @ np.array([step[4], -step[3], 1.0])
        R = upright(axis / np.linalg.norm(axis))
        if np.abs(step).max() < done:
            break
    return ScannerPose(c, R)


def _against(row: NDArray[np.intp] | None, values: Floats, weight: Floats | None = None) -> Floats:
    """Deviations (n,) of values (n,) from the median of their row, with weights from its mean; row None: differences (n / 2,)
    from the second half, of neighbours."""
    if row is None:
        half = len(values) // 2
        return values[:half] - values[half:]
    if weight is None:
        return np.asarray(values - _medians(row, values, int(row.max()) + 1)[row])
    mean = np.bincount(row, weight * values) / np.maximum(np.bincount(row, weight), 1e-12)
    return np.asarray(values - mean[row])


def _measured(P: Floats, row: NDArray[np.intp], pose: ScannerPose) -> RingFit:
    u, rows = pose.to_scanner(P), int(row.max()) + 1
    rho = np.hypot(u[:, 0], u[:, 1])
    medians = _medians(row, np.arctan2(u[:, 2], rho), rows)
    cones = ring_cones(row.astype(np.int32), u, rows)
    across = (u[:, 2] - cones[row, 0] - cones[row, 1] * rho) / np.maximum((1 + cones[row, 1] ** 2) * rho, 1e-6)
    gaps = np.diff(np.sort(medians))
    return RingFit(pose, MAD_TO_SIGMA * float(np.median(np.abs(across))), float(np.median(gaps)) if len(gaps) else 0.0)


def _medians(row: NDArray[np.intp], values: Floats, rows: int) -> Floats:
    """Median of the values of each row."""
    order = np.lexsort((values, row))
    start = np.searchsorted(row[order], np.arange(rows + 1))
    low, high = (start[:-1] + start[1:] - 1) // 2, (start[:-1] + start[1:]) // 2
    return np.asarray(0.5 * (values[order[low]] + values[order[high]]))

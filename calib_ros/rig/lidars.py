"""Edges between two LiDARs: from scans registered to each other, and where these share no view, from how both move (hand-eye)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.config import MotionConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.lidar.deskew import has_times, moved
from calib_ros.lidar.ego_motion import (
    MAX_GAP_S,
    MIN_CURVATURE,
    MIN_MATCHED,
    MIN_POINTS,
    Motion,
    align,
    estimate_motion,
    prepared,
    thinned,
)  # fmt: skip
from calib_ros.registration.motion_guess.guess import FLOOR_DEG
from calib_ros.registration.motion_guess.hand_eye import CONVERGED_RAD, OVERLAP
from calib_ros.registration.motion_guess.tracks import Run, picture_pairs
from calib_ros.rig.graph import Edge

SCANS_KIND, MOTION_KIND = "scans", "motion"  # of edges
SCANS = 20  # that are registered: what more of them show is much the same
VOXEL_M = 0.4  # half of the odometry's, since both scanners see the same at once
# Of matches: the prior's error at 30 m and more; that which MIN_MATCHED is about; and what the scans in place need.
REACHES_M = (3.0, 1.0, 0.5)
SHARED_M, SHARED = 1.5, 0.3  # points nearer than this to another scanner's by the priors are shared; so many are a view
GLIMPSES = 5  # scans of a recording that tell what a sensor sees
ROUNDS = 5  # of reweighting
# Standard deviations of what all scans have in common, so that their spread does not show it: data sheets give ranges to 1 to
# 3 cm, an offset of each laser that dozens of them average, and angles to hundredths of a degree.
COMMON_RAD, COMMON_M = np.deg2rad(0.02), 0.005
UNKNOWN_M, UNKNOWN_RAD = 10.0, 3.0  # standard deviations of what motion does not tell
STEPS = 12  # of Gauss and Newton
PARTS = 8  # of a drive, one more than its spread needs
MIN_MOTIONS = 2 * PARTS
MEDIAN_OF_SIX = 5.348  # of a chi-squared variable with six degrees of freedom
RUN_SCANS = 600  # of which the motion is found: a minute shows it
Stamped = tuple[int, PointCloud]


class LidarScans:
    """The scans of a LiDAR in the order of their stamps, and its motion between them, estimated when it is asked for. window: of
    stamps, ns, first and last, whose scans are registered; None = all. estimate: `estimate_motion`, or one that remembers."""

    def __init__(
        self,
        scans: Sequence[Stamped],
        config: MotionConfig,
        window: tuple[int, int] | None = None,
        estimate: Callable[..., Motion] = estimate_motion,
    ) -> None:
        self.scans, self.config, self._estimate = scans, config, estimate
        stamps = getattr(scans, "stamps", None)
        self.stamps = np.array([stamp for stamp, _ in scans] if stamps is None else stamps, np.int64)
        first, last = window or (self.stamps[:1].sum(), self.stamps[-1:].sum())
        self.used = np.flatnonzero((self.stamps >= first) & (self.stamps <= last))  # their positions
        self._motions: dict[int, Matrix | None] = {}
        self._still: dict[int, tuple[Matrix, Matrix | None]] = {}

    def __len__(self) -> int:
        return len(self.stamps)

    def nearest(self, stamp: int) -> int:
        """Position of the scan next to a moment, ns."""
        return int(np.argmin(np.abs(self.stamps - stamp)))

    def _motion(self, k: int) -> Matrix | None:
        """Mean velocity (6,) from scan k to the next one."""
        if not 0 <= k < len(self) - 1:
            return None
        if k not in self._motions:
            gap_s = int(self.stamps[k + 1] - self.stamps[k]) / NANOSECONDS
            if gap_s > MAX_GAP_S:
                self._motions[k] = None
            else:
                before, after = self.scans[k][1], self.scans[k + 1][1]
                self._motions[k] = self._estimate(before, after, gap_s, self._times(before), self._motions.get(k - 1)).twist
        return self._motions[k]

    def _times(self, cloud: PointCloud) -> MotionConfig:
        """A wrong guess of the times moves points farther than none: without times, all count as measured at the stamp."""
        timed = self.config.deskew != "off" and (has_times(cloud) or self.config.from_scans == "always")
        return self.config if timed else replace(self.config, spin="none")

    def twist(self, k: int) -> Matrix | None:
        """Velocity (6,) at scan k, rad/s and m/s in the LiDAR's frame; None = unknown."""
        found = [twist for twist in (self._motion(k - 1), self._motion(k)) if twist is not None]
        return np.asarray(np.mean(found, axis=0)) if found else None

    def still(self, k: int) -> tuple[Matrix, Matrix | None]:
        """Points (n, 3) of scan k, thinned, as they are at its stamp, and the velocity there."""
        if k not in self._still:
            cloud, twist = self.scans[k][1], self.twist(k)
            points, time = thinned(cloud, self._times(cloud), VOXEL_M)
            self._still[k] = points if twist is None or self.config.deskew == "off" else moved(points, twist, time), twist
        return self._still[k]

    def chosen(self, n: int) -> list[int]:
        """Up to n positions, spread evenly, few of them among SCANS."""
        own = self.used if n >= SCANS else self.chosen(SCANS)
        return [int(own[round(k)]) for k in np.linspace(0, len(own) - 1, min(n, len(own)))]

    @cached_property
    def glimpses(self) -> list[Matrix]:
        """Points (n, 3) of a few scans, spread evenly."""
        return [self.still(k)[0] for k in self.chosen(GLIMPSES)]

    @cached_property
    def run(self) -> Run | None:
        """The longest sequence of scans between which the motion is known; None where there is none."""
        spare = max(len(self.used) - RUN_SCANS, 0)
        own = self.used[spare // 2 : len(self.used) - (spare - spare // 2)].tolist()
        known = {k: self._motion(k) for k in own[:-1]}
        best, first = (0, 0), own[0] if own else 0
        for k in own:
            if known.get(k) is None:
                best, first = max(best, (first, k), key=lambda part: part[1] - part[0]), k + 1
        if best[1] == best[0]:
            return None
        twists = np.array([known[k] for k in range(*best)])
        times = (self.stamps[best[0] : best[1] + 1] - self.stamps[0]) / NANOSECONDS
        return Run.of(best[0], times, times, twists)


def shared_view(a: LidarScans, b: LidarScans, T: Transform) -> float:
    """Share of the points of the scanner that sees less which the other one sees, too, by T_a_b (4, 4): the median of a few
    scans, any of which may pass a gap."""
    if not len(a.used) or not len(b.used):
        return 0.0
    others = [a.still(a.nearest(int(b.stamps[k])))[0] for k in b.chosen(GLIMPSES)]
    return float(np.median([shared_share(A, se3.transform(T, B)) for A, B in zip(others, b.glimpses, strict=True)]))


def shared_share(A: Matrix, B: Matrix) -> float:
    """The same for points (n, 3) of both in one frame."""
    if min(len(A), len(B)) < MIN_POINTS:
        return 0.0
    tree = scipy.spatial.cKDTree
    near = [np.isfinite(tree(one).query(other, distance_upper_bound=SHARED_M)[0]).mean() for one, other in ((A, B), (B, A))]
    return float(max(near))


def scan_edge(target: tuple[str, LidarScans], source: tuple[str, LidarScans], T: Transform) -> Edge:
    """Edge from scans of the same moments, registered from T_target_source (4, 4) on, each corrected for its scanner's motion.
    Raises TooFewFeaturesError."""
    (name_a, a), (name_b, b) = target, source
    found: list[Registration] = []
    reason = "no two of their scans are of the same moment"
    for k in b.chosen(SCANS):
        j = a.nearest(int(b.stamps[k]))
        late_s = int(b.stamps[k] - a.stamps[j]) / NANOSECONDS
        if abs(late_s) > MAX_GAP_S:
            continue
        (A, twist), (B, _) = a.still(j), b.still(k)
        try:
            found.append(register(A, B, T, twist, late_s))
        except TooFewFeaturesError as error:
            reason = str(error)
    if len(found) < 2:
        raise TooFewFeaturesError(f"{name_a} and {name_b}: {reason}; give scans of more moments, or a better prior")
    return fused(name_a, name_b, found, b.config.time_offset_sigma_s)[0]


@dataclass(frozen=True, eq=False)
class Registration:
    """Of two scans of the same moment. T: T_target_source (4, 4). information: (6, 6) of a left twist, but for its scale. twist:
    (6,) velocity of the target, rad/s and m/s in its own frame."""

    T: Transform
    information: Matrix
    twist: Matrix


def register(A: Matrix, B: Matrix, T: Transform, twist: Matrix | None, late_s: float) -> Registration:
    """Registration by GICP from T_target_source (4, 4) on.

    A, B: points (n, 3) of target and source, thinned, each as at its stamp. twist: velocity (6,) of the target, None = unknown.
    late_s: by which the source's stamp is later. Raises TooFewFeaturesError.
    """
    if min(len(A), len(B)) < MIN_POINTS or (twist is None and late_s):
        raise TooFewFeaturesError("too few points in their scans, or their motion is unknown")
    between = se3.exp(np.zeros(6) if twist is None else twist * late_s)
    guess = between @ T
    # The narrower scanner's points are looked for among the wider one's.
    turned = len(B) > len(A)
    wide, narrow = (prepared(points) for points in ((B, A) if turned else (A, B)))
    inliers: list[int] = []
    for reach in REACHES_M:
        if not np.isfinite(guess).all():
            break
        result = align(wide, narrow, se3.inverse(guess) if turned else guess, reach)
        guess = np.asarray(result.T_target_source, float)
        guess = se3.inverse(guess) if turned else guess
        inliers.append(result.num_inliers)
    # Of what both see, since either sees other things, too.
    matched, H = inliers[1] / max(inliers[0], 1) if len(inliers) > 1 else 0.0, np.asarray(result.H, float)
    curvature = float(np.linalg.eigvalsh(H[3:, 3:])[0]) / max(result.num_inliers, 1)
    if not result.converged or not np.isfinite(guess).all() or matched < MIN_MATCHED or curvature < MIN_CURVATURE:
        slides = " but slide along each other" if matched >= MIN_MATCHED else f", {MIN_MATCHED:.0%} are needed"
        raise TooFewFeaturesError(f"their scans match at {matched:.0%} of the points that both see{slides}")
    # From a right twist of what was aligned to a left one of T_target_source.
    to_right = -np.eye(6) if turned else se3.adjoint(se3.inverse(guess))
    back = to_right @ se3.adjoint(between)
    return Registration(se3.inverse(between) @ guess, back.T @ H @ back, np.zeros(6) if twist is None else twist)


def fused(target: str, source: str, found: Sequence[Registration], clock_sigma_s: float) -> tuple[Edge, float]:
    """The weighted mean of registrations, and by what their information is to be divided.

    The Hessian of each tells how its directions compare, and the spread over all how large errors are; an offset of the clocks is
    estimated along, as far as the speeds tell it.
    """
    Ts, Hs, twists = [f.T for f in found], [f.information for f in found], [f.twist for f in found]
    n, T, offset = len(Ts), Ts[len(Ts) // 2], 0.0
    weights, J = np.ones(n), [np.c_[np.eye(6), twist] for twist in twists]

    def squared(x: Matrix, H: Matrix) -> float:
        return float(x @ H @ x)

    # At first no registration is known to be right: the one nearest to all.
    spread = [np.median([squared(se3.log(a @ se3.inverse(b)), H) for a, H in zip(Ts, Hs, strict=True)]) for b in Ts]
    T = Ts[int(np.argmin(spread))]
    scale = max(float(min(spread)) / MEDIAN_OF_SIX, 1e-9)
    for _ in range(ROUNDS):
        prior = np.diag(np.r_[np.zeros(6), max(clock_sigma_s, 1e-6) ** -2.0])
        r = [se3.log(t @ se3.inverse(T)) - twist * offset for t, twist in zip(Ts, twists, strict=True)]
        A = sum((w * G.T @ H @ G / scale for w, G, H in zip(weights, J, Hs, strict=True)), prior)
        g = sum((w * G.T @ H @ x / scale for w, G, H, x in zip(weights, J, Hs, r, strict=True)), -prior[:, 6] * offset)
        step = np.linalg.solve(A, g)
        T, offset = se3.exp(step[:6]) @ T, offset + float(step[6])
        r = [se3.log(t @ se3.inverse(T)) - twist * offset for t, twist in zip(Ts, twists, strict=True)]
        squares = np.array([squared(x, H) for x, H in zip(r, Hs, strict=True)])
        scale = max(float(np.median(squares)) / MEDIAN_OF_SIX * n / max(n - 1, 1), 1e-9)
        weights = 1 / (1 + np.maximum(squares / scale - 6, 0) / 6)  # beyond what is expected, as Cauchy's
    covariance = np.linalg.inv(A)
    # How registrations really scatter, frame by frame: more than the Hessian says along what all of them see badly.
    g_k = np.array([w * G.T @ H @ x / scale for w, G, H, x in zip(weights, J, Hs, r, strict=True)])
    sandwich = covariance @ (g_k.T @ g_k) @ covariance * n / max(n - 1, 1)
    common = np.diag(np.repeat([COMMON_RAD**2, COMMON_M**2], 3))
    total = 0.5 * (covariance + sandwich + np.abs(np.diag(np.diag(covariance - sandwich))))
    sigma = float(np.sqrt(total[6, 6]))
    twist = np.asarray(se3.adjoint(se3.inverse(T)) @ np.mean(twists, axis=0))
    return Edge(target, source, T, _symmetric(total[:6, :6] + common), SCANS_KIND, offset, sigma, twist, n), scale


def _symmetric(C: Matrix) -> Covariance:
    return np.asarray(0.5 * (C + C.T))


def motion_edge(target: tuple[str, LidarScans], source: tuple[str, LidarScans], T: Transform) -> Edge:
    """Edge from the odometries of two LiDARs, which need not see the same: A X = X B for every motion (Tsai and Lenz 1989), from
    X = T_target_source (4, 4) on. What the motion does not tell, as heights where the ground is flat, has a large variance.
    Raises TooFewFeaturesError."""
    (name_a, a), (name_b, b) = target, source
    run, other = a.run, b.run
    if run is None or other is None:
        raise TooFewFeaturesError(f"{name_a} and {name_b}: the motion of {name_a if run is None else name_b} is unknown")
    shift = int(a.stamps[0] - b.stamps[0]) / NANOSECONDS
    pairs = np.array([(run.times[i], run.times[j]) for i, j in picture_pairs(run)]).reshape(-1, 2)
    both = (pairs[:, 0] + shift >= other.times[0]) & (pairs[:, 1] + shift <= other.times[-1])
    starts, ends = pairs[both].T
    if len(starts) < MIN_MOTIONS:
        raise TooFewFeaturesError(f"{name_a} and {name_b}: they moved too little; give some seconds of driving, with a bend")
    return hand_eye_edge(name_a, name_b, run.relative(starts, ends), other.relative(starts + shift, ends + shift), T)


def hand_eye_edge(target: str, source: str, A: Matrix, B: Matrix, T: Transform) -> Edge:
    """The same from motions (n, 4, 4) of target and source, at least MIN_MOTIONS in the order of time."""
    X, H = _hand_eye(A, B, T)
    # Errors of odometry last: what one part of the drive says against the others is more than residuals let expect (jackknife).
    parts = np.array_split(np.arange(len(A)), PARTS)
    others = [_hand_eye(np.delete(A, part, 0), np.delete(B, part, 0), X)[0] for part in parts if len(A) - len(part) >= 2]
    apart = np.array([se3.log(other @ se3.inverse(X)) for other in others])
    apart -= apart.mean(axis=0)
    spread = apart.T @ apart * (len(apart) - 1) / len(apart)
    common = np.diag(np.repeat([np.deg2rad(FLOOR_DEG) ** 2, COMMON_M**2], 3))
    return Edge(target, source, X, _symmetric(np.linalg.inv(H) + spread + common), MOTION_KIND, samples=len(A))


def _hand_eye(A: Matrix, B: Matrix, X: Transform) -> tuple[Transform, Matrix]:
    """X with A X = X B for motions (n, 4, 4), robustly from X on, and its information (6, 6)."""
    floor = np.diag(np.repeat([UNKNOWN_RAD**-2.0, UNKNOWN_M**-2.0], 3))
    H = floor
    for _ in range(STEPS):
        r = np.array([se3.log(one @ X @ se3.inverse(two) @ se3.inverse(X)) for one, two in zip(A, B, strict=True)])
        # exp(x) X B X^-1 exp(-x) = exp((I - Ad(X B X^-1)) x) X B X^-1
        J = np.array([np.eye(6) - se3.adjoint(X @ two @ se3.inverse(X)) for two in B])
        sigma = np.array([np.median(np.abs(r[:, :3])), np.median(np.abs(r[:, 3:]))]) / scipy.special.ndtri(0.75)
        W = np.repeat(sigma.clip(1e-5) ** -2.0, 3)
        weights = 1 / (1 + np.maximum((r * r * W).sum(axis=1) - 6, 0) / 6)
        H = np.einsum("n,nij,i,nik->jk", weights, J, W, J) / OVERLAP + floor
        step = np.linalg.solve(H, np.einsum("n,nij,i,ni->j", weights, J, W, r) / OVERLAP)
        X = se3.exp(step) @ X
        if np.abs(step).max() < CONVERGED_RAD:
            break
    return X, H

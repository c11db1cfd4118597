"""The offset between the clocks of camera and LiDAR, estimated together with the extrinsic: the seventh unknown.

With an offset x every point is measured x seconds later than its stamp says, and lies at exp(twist x) p in the LiDAR frame at the
moment of the image: its picture moves as if the extrinsic moved by the twist adjoint(T) twist per second. Where all frames move
alike that is one direction of the extrinsic, and nothing can be told; where they differ, the score has one maximum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.config import MotionConfig
from calib_ros.config.sensors import MAX_OFFSET_S
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.nuisance.clock_offset import ClockOffset
from calib_ros.registration.nuisance.parameters import (
    LEVELS,
    MIN_FRAMES,
    NEAR_LEVELS,
    POINTS,
    REACH,
    SIGNIFICANT_Z,
    TOLERANCE_DEG,
    Effect,
    noise_of,
    refined,
)
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, Prior
from calib_ros.registration.search.optimizers import JointView, ascend_jointly, joint_jacobian

# In scan periods: a driver that stamps scans at the other end is one off. Where the best is so many steps away, it is looked for
# everywhere: it may be only the best that is near.
RANGE_PERIODS = 1.5
FAR_STEPS = 2
STEP_PERIODS = 0.25  # between starts; edges then move by no more than the coarse levels are blurred
# Edge points of the final optimum. On 16 consecutive KITTI frames the offset repeats to 7 ms with 6000, to 2 ms with 20000.
FINE_POINTS, NEAR_POINTS = 20000, 8000  # after a search, and near an extrinsic that is known
LEAST_S = 1e-3  # s; no stamps are better
STAMP_SCATTER_S = MotionConfig.time_offset_sigma_s  # by which stamps scatter at most, where clocks are not better known
SINGULAR = 1e-9  # of the largest eigenvalue, below which rounding decides
OBSERVABLE_SIGMAS = 2.0  # by which an offset of motion.max_time_offset_s must differ from 0 to count as observable


def with_known_motion(features: Sequence[FrameFeatures], score: PointScore) -> tuple[PointScore, Matrix] | None:
    """The part of a score whose frames have a known velocity of the LiDAR, and these, (n_frames, 6) rad/s and m/s, 0 for the
    others; None if there is none."""
    known = np.array([f.twist is not None for f in features])
    twists = np.array([np.zeros(6) if f.twist is None else f.twist for f in features])
    points = known[score.frame]
    if not points.any():
        return None
    return (score if points.all() else score.select(points)), twists


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """A joint optimum in seven unknowns.

    seconds: the offset, as a change of motion.time_offset_s. T: T_camera_lidar (4, 4) there. sigma_s: standard deviation of the
    offset by the data. gain: by how much the score exceeds that of the best extrinsic without an offset, in standard deviations.
    effect: how the extrinsic depends on it. width_s: of the range that was searched. score: there. noise: see `noise_of`.
    """

    seconds: float
    T: Transform
    sigma_s: float
    gain: float
    effect: Effect
    width_s: float
    score: float
    noise: float

    def observable(self, config: MotionConfig) -> bool:
        """True if an offset of motion.max_time_offset_s would show."""
        return OBSERVABLE_SIGMAS * self.sigma_s <= config.max_time_offset_s

    def exists(self, config: MotionConfig) -> bool:
        """True if there is an offset to be used: observable, and more probable than none, or known as well as in advance."""
        known = self.probability > 0.5 or self.sigma_s <= config.time_offset_sigma_s
        return known and abs(self.seconds) > LEAST_S and self.observable(config)

    def suspected(self, config: MotionConfig) -> bool:
        """True if other clocks match better, but by no offset that is known. Beyond the range that is searched, what is hardly
        observable may drift to any value."""
        better = self.gain > SIGNIFICANT_Z and self.probability > 0.5
        return better and abs(self.seconds) <= MAX_OFFSET_S and not self.observable(config)

    @property
    def probability(self) -> float:
        """Probability that there is an offset, if one anywhere in the range is as likely in advance as none: the Bayes factor of
        one more parameter (Laplace's approximation)."""
        log_ratio = 0.5 * self.gain**2 + np.log(self.sigma_s * np.sqrt(2 * np.pi) / self.width_s)
        return float(1 / (1 + np.exp(-np.clip(log_ratio, -50, 50))))

    def better_than(self, other: TimeOffset, alternatives: int) -> bool:
        """Is this a better match of the same edge points than another, if it is one of so many that were tried?"""
        log_ratio = (self.score - other.score) / max(self.noise, other.noise)
        return bool(log_ratio > np.log(alternatives))


def estimate_time_offset(
    score: PointScore,
    T: Transform,
    limits: Limits,
    prior: Prior | None,
    twists: Matrix,
    config: MotionConfig,
    search: bool,
) -> TimeOffset | None:
    """The joint optimum of extrinsic and time offset; None where the frames are too few or do not move differently.

    score: of frames of known motion. T: (4, 4), their optimum without an offset. twists: (n_frames, 6) of the LiDAR, rad/s and
    m/s. search: in the whole range, and beyond where the best is not near 0; else the optimum near 0.
    """
    own = np.unique(score.frame)
    if len(own) < MIN_FRAMES or not limits.open_axes.any() or not np.ptp(twists[own], axis=0).any():
        return None
    reach = np.where(limits.open_axes, REACH, 0.0)
    fine = score.subset(FINE_POINTS if search else NEAR_POINTS, np.random.default_rng(0))
    range_s = RANGE_PERIODS * config.scan_period_s
    best, seconds = T, 0.0
    if search:
        best, seconds = _coarse(
            score.subset(POINTS, np.random.default_rng(0)), T, limits, twists, range_s, STEP_PERIODS * config.scan_period_s
        )
    without = max(refined(fine, T, Limits(T, reach), NEAR_LEVELS, TOLERANCE_DEG)[1], fine.at(-1).value(T))
    free = Limits(T, np.where(limits.open_axes, np.inf, 0.0))
    best, seconds, highest = _ascend(fine, best, seconds, twists, free, prior)
    moved = fine.moved(twists, seconds)
    effect = ClockOffset(0.0, twists).effect(moved, best, limits, FINE_POINTS)
    noise = noise_of(fine, T, limits)
    scatter_s = min(STAMP_SCATTER_S, config.time_offset_sigma_s)
    certain = 1 / (1 + effect.information * scatter_s**2 * scatter_gain(moved, best, twists, limits))
    effect = replace(effect, information=certain * effect.information)
    gain = float(np.sqrt(max(2 * (highest - without) / noise * certain, 0.0)))
    found = TimeOffset(seconds, best, effect.sigma(range_s), gain, effect, 2 * range_s, highest, noise)
    if not found.exists(config) or fine is score:
        return found
    best, seconds, _ = _ascend(score, best, seconds, twists, free, prior)
    return replace(found, seconds=seconds, T=best)


def scatter_gain(score: PointScore, T: Transform, twists: Matrix, limits: Limits) -> float:
    """Variance of the offset at the joint optimum by that of stamps that scatter from frame to frame.

    Where frames hardly differ in speed, one stamp that is a millisecond late looks like an offset of many. Linear in the frames'
    own optima, which it moves.
    """
    J, axes = joint_jacobian(view_at(score, T, twists), 1, score.n_levels - 1), np.append(np.flatnonzero(limits.open_axes), 6)
    whole, squares = np.zeros((7, 7)), np.zeros((7, 7))
    for k in np.unique(score.frame):
        own = J[:, score.frame == k]
        information = own * score.weights[score.frame == k] @ own.T
        whole += information
        squares += np.outer(information[:, 6], information[:, 6])
    whole, squares = whole[np.ix_(axes, axes)], squares[np.ix_(axes, axes)]
    unit = 1 / np.sqrt(np.maximum(np.diag(whole), np.finfo(float).tiny))
    pull = np.linalg.pinv(whole * np.outer(unit, unit), rcond=SINGULAR, hermitian=True)[-1] * unit * unit[-1]
    return float(pull @ squares @ pull)


def _coarse(
    score: PointScore, T: Transform, limits: Limits, twists: Matrix, range_s: float, step_s: float
) -> tuple[Matrix, float]:
    """The best of offsets at regular steps, s, and the extrinsic (4, 4) there."""
    reach, free = np.where(limits.open_axes, REACH, 0.0), Limits(T, np.where(limits.open_axes, np.inf, 0.0))
    best, seconds, highest, clocks = T, 0.0, -np.inf, ClockOffset(0.0, twists)
    near, far = round(range_s / step_s), int(MAX_OFFSET_S / step_s)
    for steps in (range(-near, near + 1), [k for k in range(-far, far + 1) if abs(k) > near]):
        for k in steps:
            other, begin = clocks.changed(score, T, k * step_s)
            # Frames that agree on the extrinsic may be those at rest, whose optimum does not move.
            begin = max(free.clip(begin), T, key=other.at(LEVELS[0]).value)
            end, value = refined(other, begin, Limits(begin, reach), LEVELS, TOLERANCE_DEG)
            if value > highest:
                best, seconds, highest = end, k * step_s, value
        if abs(seconds) < FAR_STEPS * step_s:  # the clocks agree more or less: nothing is to be found far away
            break
    return best, seconds


def _ascend(
    score: PointScore, T: Transform, seconds: float, twists: Matrix, limits: Limits, prior: Prior | None
) -> tuple[Matrix, float, float]:
    """The optimum in seven unknowns near T (4, 4) and an offset. -> T (4, 4), seconds, score."""

    def see(T: Transform, offset: Matrix) -> JointView:
        return view_at(score.moved(twists, offset[0]), T, twists)

    T, offset, value = ascend_jointly(see, T, np.array([seconds]), NEAR_LEVELS, limits, prior)
    return T, float(offset[0]), value


def view_at(score: PointScore, T: Transform, twists: Matrix) -> JointView:
    """The points of a score at an offset, seen from T (4, 4)."""
    flow = np.asarray(twists @ se3.adjoint(T).T)  # (n_frames, 6), of every frame in the camera's axes
    return score, T, lambda J: np.einsum("kn,nk->n", J, flow[score.frame])

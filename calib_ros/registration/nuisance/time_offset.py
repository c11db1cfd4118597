"""The offset between the clocks of camera and LiDAR, estimated together with the extrinsic: the seventh unknown.

With an offset x every point is measured x seconds later than its stamp says, so that it lies at exp(twist x) p in the LiDAR frame
at the moment of the image. Its picture moves as if the extrinsic moved by the twist adjoint(T) twist per second: the derivative
by the offset is that by the extrinsic, applied to the velocity of the point's own frame. Where all frames move alike that is one
direction of the extrinsic, and nothing can be told; where speeds or turns differ, the score has one maximum in seven unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.config import MotionConfig
from calib_ros.config.sensors import MAX_OFFSET_S
from calib_ros.registration.acceptance.refusal import WrongTimes
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.nuisance.parameters import (
    LEVELS,
    MIN_FRAMES,
    NEAR_LEVELS,
    POINTS,
    REACH,
    SIGNIFICANT_Z,
    TOLERANCE_DEG,
    Changed,
    Effect,
    NuisanceParameter,
    noise_of,
    refined,
)
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, Prior
from calib_ros.registration.search.optimizers import learned_curvature

# An offset is looked for this far away, in scan periods: a driver that stamps scans at the other end is one period off. Where the
# best is so many steps away, it is looked for everywhere: it may be only the best that is near.
RANGE_PERIODS = 1.5
FAR_STEPS = 2
STEP_PERIODS = 0.25  # between starts; edges then move by no more than the coarse levels are blurred
ITERATIONS, SMALLEST_STEP_S = 15, 1e-5
# Edge points of the final optimum. On 16 consecutive KITTI frames the offset repeats to 7 ms with 6000, to 2 ms with 20000.
FINE_POINTS, NEAR_POINTS = 20000, 8000  # after a search, and near an extrinsic that is known
LEAST_S = 1e-3  # s; no stamps are better
GAIN = 1e-7  # of the score; a step that gains less is rounding
OBSERVABLE_SIGMAS = 2.0  # by which an offset of motion.max_time_offset_s must differ from 0 to count as observable


@dataclass(frozen=True, eq=False)
class ClockOffset(NuisanceParameter):
    """The offset of the clocks, s, as a change of motion.time_offset_s. twists: (n_frames, 6) of the LiDAR, rad/s and m/s.

    What all frames have in common of their motion only moves the optimum, and tells nothing of the offset.
    """

    twists: Matrix
    name = "time_offset_s"
    gross = 0.05
    step = 0.03  # 3 px at a turn of 5 deg/s, or at 10 m/s and 20 m beside the way
    alternatives = (-0.1, -0.075, -0.05, -0.025, 0.025, 0.05, 0.075, 0.1)  # up to one scan at 10 Hz

    def changed(self, score: PointScore, T: Transform, value: float) -> Changed:
        """See NuisanceParameter: what all frames have in common of their motion turns the extrinsic back."""
        weight = np.bincount(score.frame, score.weights, len(self.twists))
        common = weight @ self.twists / weight.sum()
        return score.moved(self.twists, value), T @ se3.exp(-common * value)

    def observable_in(self, score: PointScore) -> bool:
        """See NuisanceParameter: a vehicle at rest shows no offset of its own."""
        return bool(self.twists.any())

    def refusal(self, value: float, deviations: float) -> WrongTimes:
        """See NuisanceParameter."""
        return WrongTimes(value, deviations)


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
    offset, s, as far as the data tell. gain: by how much the score exceeds that of the best extrinsic without an offset, in
    standard deviations. effect: how the extrinsic depends on it. width_s: of the range that it was looked for in, s. score: at
    the optimum. noise: of the score, see `noise_of`.
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
        """True if there is an offset to be used: observable, and more probable than none, or known at least as well as the clocks
        are in advance, which an earlier estimate may have told from fewer frames."""
        known = self.probability > 0.5 or self.sigma_s <= config.time_offset_sigma_s
        return known and abs(self.seconds) > LEAST_S and self.observable(config)

    def suspected(self, config: MotionConfig) -> bool:
        """True if something else than the clocks as they are matches better, but it is no offset that is known."""
        return self.gain > SIGNIFICANT_Z and self.probability > 0.5 and not self.observable(config)

    @property
    def probability(self) -> float:
        """Probability that there is an offset, if one anywhere in the range is as likely in advance as none.

        Bayes factor of a model with one more parameter (Laplace's approximation): what the optimum gains in likelihood, less
        what is lost to all the other offsets that it could have been.
        """
        log_ratio = 0.5 * self.gain**2 + np.log(self.sigma_s * np.sqrt(2 * np.pi) / self.width_s)
        return float(1 / (1 + np.exp(-np.clip(log_ratio, -50, 50))))

    def better_than(self, other: TimeOffset, alternatives: int) -> bool:
        """Is this a better match of the same edge points than another, if it is one of so many that were tried?

        The noise is that of either score; most of it both have in common, so that their difference has less.
        """
        log_ratio = (self.score - other.score) / max(self.noise, other.noise)
        return bool(log_ratio > np.log(alternatives))

    def sigma_if_none(self, prior_s: float) -> float:
        """Standard deviation of the offset, s, where it is taken to be 0 and known to `prior_s` then: there may be one all the
        same."""
        return float(np.hypot(self.effect.sigma(prior_s), np.sqrt(self.probability) * self.seconds))


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

    score: of frames of known motion. T: (4, 4), their optimum without an offset. limits, prior: of the extrinsic. twists:
    (n_frames, 6) of the LiDAR, rad/s and m/s. search: the whole range is searched, and all that motion.time_offset_s can hold
    where the best is not near 0; else the optimum near 0.
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
    best, seconds, highest = ascend(fine, best, seconds, twists, free, prior, NEAR_LEVELS)
    effect = ClockOffset(0.0, twists).effect(fine.moved(twists, seconds), best, limits, FINE_POINTS)
    noise = noise_of(fine, T, limits)
    gain = float(np.sqrt(max(2 * (highest - without) / noise, 0.0)))
    found = TimeOffset(seconds, best, effect.sigma(range_s), gain, effect, 2 * range_s, highest, noise)
    if not found.exists(config) or fine is score:
        return found
    best, seconds, _ = ascend(score, best, seconds, twists, free, prior, NEAR_LEVELS)
    return replace(found, seconds=seconds, T=best)


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


def ascend(
    score: PointScore, T: Transform, seconds: float, twists: Matrix, limits: Limits, prior: Prior | None, levels: Sequence[int]
) -> tuple[Matrix, float, float]:
    """The optimum in seven unknowns near T (4, 4) and an offset, level by level: damped Gauss-Newton steps as in
    `optimizers.levenberg_marquardt`, whose curvature is learnt on the way. -> T (4, 4), seconds, score."""
    value = 0.0
    for level in levels:
        T, seconds, value = _ascend(score, T, seconds, twists, limits, prior, level)
    return T, seconds, value


def _ascend(
    score: PointScore, T: Transform, seconds: float, twists: Matrix, limits: Limits, prior: Prior | None, level: int
) -> tuple[Matrix, float, float]:
    part = score.moved(twists, seconds)
    best = part.at(level).value(T)
    objective = best - (prior.value(T) if prior else 0.0)
    damping, H, last, step = 1e-2, np.zeros((7, 7)), np.zeros(7), np.zeros(7)
    for n in range(ITERATIONS):
        ascent, scale = linearise(part, T, twists, level)
        H = learned_curvature(H, step, last - ascent) if n else scale
        gradient, B = ascent.copy(), H.copy()
        if prior:
            gradient[:6] -= prior.cost(T)[1]
            B[:6, :6] += np.diag(prior.information)
        axes = np.flatnonzero(np.append(limits.movable(T, gradient[:6]), True))
        for _ in range(6):
            step = np.zeros(7)
            damped = B[np.ix_(axes, axes)] + np.diag(damping * np.diag(B)[axes] + 1e-9)
            step[axes] = np.linalg.solve(damped, gradient[axes])
            candidate, later = limits.clip(se3.exp(step[:6]) @ T), seconds + step[6]
            moved = score.moved(twists, later)
            value = moved.at(level).value(candidate)
            penalised = value - (prior.value(candidate) if prior else 0.0)
            if penalised > objective + GAIN:
                break
            damping = max(damping * 6, 1e-3)
        else:
            break
        T, seconds, part, best, objective, last = candidate, later, moved, value, penalised, ascent
        damping /= 4
        if abs(step[6]) < SMALLEST_STEP_S and np.abs(step[:3]).max() < 2e-6 and np.abs(step[3:6]).max() < 2e-5:
            break
    return T, float(seconds), best


def linearise(score: PointScore, T: Transform, twists: Matrix, level: int) -> tuple[Matrix, Matrix]:
    """Gradient (7,) of the score by a left twist at T (4, 4) and by the offset, and the weighted outer products of the points'
    derivatives (7, 7). score: of points at the present offset."""
    J = np.empty((7, score.points.shape[1]))
    J[:6] = score.jacobian(T, level)
    flow = np.asarray(twists @ se3.adjoint(T).T)  # (n_frames, 6), of every frame in the camera's axes
    J[6] = np.einsum("kn,nk->n", J[:6], flow[score.frame])
    weighted = J * score.weights
    return weighted.sum(axis=1), weighted @ J.T

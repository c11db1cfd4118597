"""The offset between the clocks of camera and LiDAR: estimated together with the extrinsic, as the seventh unknown, and judged.

With an offset x every point is measured x seconds later than its stamp says, and lies at exp(twist x) p in the LiDAR frame at the
moment of the image: its picture moves as if the extrinsic moved by the twist adjoint(T) twist per second. Where all frames move
alike that is one direction of the extrinsic, and nothing can be told; where they differ, the score has one maximum. Twists are
(n_frames, 6) of the LiDAR, rad/s and m/s; offsets are changes of motion.time_offset_s, s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.config import MotionConfig
from calib_ros.config.sensors import MAX_OFFSET_S
from calib_ros.registration.covariance import REGIONS, disagreement, inflation, noise_of, scenes_of
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.judgement.refusal import GROSSLY, OPEN_PROBABILITY, SIGNIFICANCE, Refusal, left_open, wrong_times
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, PoseConstraints, Prior
from calib_ros.registration.search.optimizers import (
    LEVELS,
    NEAR_LEVELS,
    NEAR_POINTS,
    NEAR_TOLERANCE_DEG,
    POINTS,
    REACH,
    TOLERANCE_DEG,
    JointView,
    ascend_jointly,
    joint_jacobian,
    refined,
)

# In scan periods: a driver that stamps scans at the other end is one off. Where the best is so many steps away, it is looked for
# everywhere: it may be only the best that is near.
RANGE_PERIODS = 1.5
FAR_STEPS = 2
STEP_PERIODS = 0.25  # between starts; edges then move by no more than the coarse levels are blurred
# Edge points of the final optimum. On 16 consecutive KITTI frames the offset repeats to 7 ms with 6000, to 2 ms with 20000.
FINE_POINTS, KNOWN_POINTS = 20000, 8000  # after a search, and near an extrinsic that is known
LEAST_S = 1e-3  # s; no stamps are better
STAMP_SCATTER_S = MotionConfig.time_offset_sigma_s  # by which stamps scatter at most, where clocks are not better known
SINGULAR = 1e-9  # of the largest eigenvalue, below which rounding decides
OBSERVABLE_SIGMAS = 2.0  # by which an offset of motion.max_time_offset_s must differ from 0 to count as observable
SIGNIFICANT_Z, MIN_FRAMES = 2.5, 3  # gain from which another offset is preferred, and the frames it takes

# Of the profile: the score with each offset at an extrinsic of its own (Murphy and van der Vaart 2000).
GROSS_S = 0.05  # standard deviation of offsets that are plainly wrong
STEP_S = 0.03  # 3 px at a turn of 5 deg/s, or at 10 m/s and 20 m beside the way
ALTERNATIVES_S = (-0.1, -0.075, -0.05, -0.025, 0.025, 0.05, 0.075, 0.1)  # up to one scan at 10 Hz
BRACKETING = 6  # steps from the best of the alternatives, of which the next one is a few steps away, until its top lies between
FARTHEST = 2.0  # steps


@dataclass(frozen=True, eq=False)
class Effect:
    """How the offset moves the optimum. direction: (6,) twist of it, rad/s and m/s. information: what the scenes tell of the
    offset, the inverse of its variance."""

    direction: Matrix
    information: float

    def sigma(self, prior: float) -> float:
        """Standard deviation of the offset, if it is `prior` in advance."""
        return float(1 / np.sqrt(self.information + 1 / prior**2)) if prior > 0 else 0.0

    def covariance(self, prior: float) -> Covariance:
        """(6, 6), what the offset leaves open of the extrinsic. prior: its standard deviation in advance."""
        shift = self.sigma(prior) * self.direction
        return np.outer(shift, shift)

    def constrained(self, constraints: PoseConstraints, covariance: Covariance, prior: float) -> Effect:
        """The same under prior and limits of the extrinsic. covariance: (6, 6) of the optimum, its prior counted."""
        direction = self.direction
        if constraints.prior:
            direction = direction - covariance @ (constraints.information() * direction)
        sigma = self.sigma(prior)
        farthest = constraints.limits.half / sigma if sigma else np.full(6, np.inf)
        return replace(self, direction=np.clip(direction, -farthest, farthest))


def at_offset(score: PointScore, T: Transform, twists: Matrix, seconds: float) -> tuple[PointScore, Matrix]:
    """The score with another offset, and where its optimum is looked for if T (4, 4) is the one without: what all frames have in
    common of their motion turns the extrinsic back."""
    weight = np.bincount(score.frame, score.weights, len(twists))
    common = weight @ twists / weight.sum()
    return score.moved(twists, seconds), T @ se3.exp(-common * seconds)


def offset_effect(score: PointScore, T: Transform, twists: Matrix, limits: Limits, points: int = NEAR_POINTS) -> Effect:
    """How an offset moves the optimum T (4, 4), refined anew a step to either side. points: edge points used at most."""
    if not twists.any():  # a vehicle at rest shows no offset of its own
        return Effect(np.zeros(6), 0.0)
    limits = _any_twist(T, limits)  # at speed, a step is farther than the trust region
    part = score.subset(points, np.random.default_rng(0))
    changes = [at_offset(part, T, twists, x) for x in (-STEP_S, 0.0, STEP_S)]
    ends, values = zip(*(refined(*own, limits, NEAR_LEVELS, NEAR_TOLERANCE_DEG) for own in changes), strict=True)
    direction = np.where(limits.open_axes, se3.log(ends[2] @ se3.inverse(ends[0])), 0.0) / (2 * STEP_S)
    fallen = max(values[1] - 0.5 * (values[0] + values[2]), 0.0)
    return Effect(direction, 2 * fallen / STEP_S**2 / noise_of(part, T, limits))


def _any_twist(T: Transform, limits: Limits) -> Limits:
    """Around T (4, 4), only the fixed axes."""
    return Limits(T, np.where(limits.open_axes, np.inf, 0.0))


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


def estimate_time_offset(
    score: PointScore, T: Transform, limits: Limits, prior: Prior | None, twists: Matrix, config: MotionConfig, search: bool
) -> TimeOffset | None:
    """The joint optimum of extrinsic and time offset; None where the frames are too few or do not move differently.

    score: of frames of known motion. T: (4, 4), their optimum without an offset. twists: (n_frames, 6) of the LiDAR, rad/s and
    m/s. search: in the whole range, and beyond where the best is not near 0; else the optimum near 0.
    """
    own = np.unique(score.frame)
    if len(own) < MIN_FRAMES or not limits.open_axes.any() or not np.ptp(twists[own], axis=0).any():
        return None
    reach, free = np.where(limits.open_axes, REACH, 0.0), _any_twist(T, limits)
    fine = score.subset(FINE_POINTS if search else KNOWN_POINTS, np.random.default_rng(0))
    range_s = RANGE_PERIODS * config.scan_period_s
    best, seconds = T, 0.0
    if search:
        best, seconds = _coarse(
            score.subset(POINTS, np.random.default_rng(0)), T, limits, twists, range_s, STEP_PERIODS * config.scan_period_s
        )
    without = max(refined(fine, T, Limits(T, reach), NEAR_LEVELS, TOLERANCE_DEG)[1], fine.at(-1).value(T))
    best, seconds, highest = _ascend(fine, best, seconds, twists, free, prior)
    moved = fine.moved(twists, seconds)
    effect = offset_effect(moved, best, twists, limits, FINE_POINTS)
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
    reach, free = np.where(limits.open_axes, REACH, 0.0), _any_twist(T, limits)
    best, seconds, highest = T, 0.0, -np.inf
    near, far = round(range_s / step_s), int(MAX_OFFSET_S / step_s)
    for steps in (range(-near, near + 1), [k for k in range(-far, far + 1) if abs(k) > near]):
        for k in steps:
            other, begin = at_offset(score, T, twists, k * step_s)
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


def refuse_clocks(
    score: PointScore,
    T: Transform,
    twists: Matrix,
    limits: Limits,
    prior_s: float,
    tolerance: tuple[float, float],
    inflated: float = 1.0,
) -> Refusal | None:
    """Why the optimum T (4, 4) of a search, which may belong to an offset far off, is not to be used: the offset is significantly
    not as given, such that the extrinsic would be off by more than the tolerance, or plainly wrong with a probability above
    OPEN_PROBABILITY.

    limits: axes that are fixed stay so. prior_s: standard deviation of the offset in advance. tolerance: deg and m. inflated:
    factor of the noise, by the disagreement of halves at T.
    """
    if not limits.open_axes.any() or not twists.any():
        return None
    freedom = max(REGIONS * scenes_of(score) - 7, 1.0)  # of the noise, regions of frames less the unknowns
    value, effect = _profiled(score.subset(POINTS, np.random.default_rng(0)), T, twists, limits, inflated)
    sigma = float(1 / np.sqrt(effect.information)) if effect.information > 0 else np.inf  # by the scenes alone
    turn, shift = (float(np.linalg.norm(part)) for part in np.split(effect.direction, 2))
    largest = min(tolerance[0] / max(float(np.rad2deg(turn)), 1e-12), tolerance[1] / max(shift, 1e-12))
    deviations = abs(value) / max(float(np.hypot(sigma, prior_s)), 1e-12)
    if 2 * scipy.special.stdtr(freedom, -deviations) < SIGNIFICANCE and abs(value) > largest:
        return wrong_times(value, deviations)
    # Is it plainly wrong and farther off than the largest, if GROSSLY of all that are given are?
    odds = GROSSLY / (1 - GROSSLY)
    if np.isfinite(sigma):  # else the scenes show nothing, and it is as likely as in advance
        usual, gross = np.hypot(sigma, prior_s), np.hypot(sigma, GROSS_S)
        by_gross, by_usual = (-0.5 * (freedom + 1) * np.log1p((value / s) ** 2 / freedom) for s in (gross, usual))  # Student's
        odds *= usual / gross * np.exp(min(by_gross - by_usual, 50.0))
    left = effect.sigma(GROSS_S)
    mean = value * effect.information * left**2
    below, above = scipy.special.ndtr(np.array([-largest - mean, mean - largest]) / left)
    probability = float(odds / (1 + odds) * (below + above))
    return left_open("time_offset_s", value, sigma, probability, *tolerance) if probability > OPEN_PROBABILITY else None


def _profiled(score: PointScore, T: Transform, twists: Matrix, limits: Limits, inflated: float) -> tuple[float, Effect]:
    """Where the profile is highest, s; 0 = as given. And how the offset moves the optimum there."""
    free = _any_twist(T, limits)
    # Around where each begins, not within a search's bounds: near one of them only other values could go on.
    reach = np.where(limits.open_axes, REACH, 0.0)

    def far(x: float) -> tuple[Matrix, float]:
        other, start = at_offset(score, T, twists, x)
        start = free.clip(start)
        return refined(other, start, Limits(start, reach), LEVELS, TOLERANCE_DEG)

    tried = {x: far(x) for x in (0.0, *ALTERNATIVES_S)}
    best = max(tried, key=lambda x: tried[x][1])
    T_best = tried[best][0]

    def near(k: int) -> tuple[Matrix, float]:
        """The profile k steps from `best`, from the optimum there on."""
        (other, there), (_, here) = (at_offset(score, T, twists, x) for x in (best + k * STEP_S, best))
        return refined(other, T_best @ se3.inverse(here) @ there, free, NEAR_LEVELS, NEAR_TOLERANCE_DEG)

    profile, top = {k: near(k) for k in (-1, 0, 1)}, 0
    for _ in range(BRACKETING):
        top = max(profile, key=lambda k: profile[k][1])
        if min(profile) < top < max(profile):
            break
        beyond = top + 1 if top == max(profile) else top - 1
        profile[beyond] = near(beyond)
    top = min(max(top, min(profile) + 1), max(profile) - 1)
    (T_low, low), (T_here, here), (T_high, high) = (profile[k] for k in (top - 1, top, top + 1))
    value = best + top * STEP_S
    fallen = here - 0.5 * (low + high)  # by one step to either side
    direction = np.where(limits.open_axes, se3.log(T_high @ se3.inverse(T_low)), 0.0) / (2 * STEP_S)
    if fallen <= 0:
        return value, Effect(direction, 0.0)
    seen = at_offset(score, T, twists, value)[0]
    noise = noise_of(seen, T_here, free)
    # Vertex of the parabola through the three, in steps; farther away it says nothing.
    value += STEP_S * float(np.clip(0.25 * (high - low) / fallen, -FARTHEST, FARTHEST))
    information = 2 * fallen / STEP_S**2 / noise
    if abs(value) > STEP_S:  # a top elsewhere that is hardly higher is one of chance: the profile between is no parabola
        given = profile[0][1] if best == 0 else refined(score, T, free, NEAR_LEVELS, NEAR_TOLERANCE_DEG)[1]
        information = min(information, 2 * max(here - given, 0.0) / noise / value**2)
        if inflated > 1:  # halves may disagree because of the wrong value
            inflated = min(inflated, inflation(disagreement(seen, T_here, free)))
    return value, Effect(direction, information / inflated)

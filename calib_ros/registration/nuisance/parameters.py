"""What an estimate takes for granted besides the extrinsic: the intrinsics and the clocks. Do they fit, and what if they are off?

Another focal length, or an offset of the clocks, is one more unknown of the registration. The scenes tell some of it: the
extrinsic is refined anew with another value, and the match gets worse, or clearly better. What they do not tell moves the
extrinsic along one direction, and belongs to its covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.registration.acceptance.refusal import WrongTimes
from calib_ros.registration.covariance import NO_NOISE, noise_covariance, noise_level
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, PoseConstraints
from calib_ros.registration.search.optimizers import levenberg_marquardt

Matrix = NDArray[np.float64]
Value = TypeVar("Value")
Changed = tuple[PointScore, Matrix]  # the score with another value of an unknown, and where to begin

# Of an unknown to either side: so far that edges move by a pixel or more, and no further than their blurred maps reach.
FOCAL_STEP = 0.005  # share of the focal length; 3 px at the border of an image of 1280
TIME_STEP_S = 0.03  # 3 px at a turn of 5 deg/s, or at 10 m/s and 20 m beside the way
NEAR_POINTS, NEAR_LEVELS, NEAR_TOLERANCE_DEG = 4000, (3, 4), 0.003  # edge points and levels on which that is refined

# Points and levels for values farther off: 3 % of the focal length move the extrinsic by 3 deg and 40 cm. REACH: twice as far.
POINTS, LEVELS, TOLERANCE_DEG = 6000, (1, 2, 3, 4), 0.01
REACH = np.array([np.deg2rad(6.0)] * 3 + [0.8] * 3)  # rad, m
# Gain from which another value is preferred, in standard deviations of the score and as a share of it, and the frames it takes:
# one frame may gain 7 by chance. Of 59 sets of five frames of 20 rigs and seven vehicles that are accepted with the right ones,
# focal lengths gain at most 1.0 and principal points 2.2, or 3.5 but 1 % of the score (a rolling shutter). Focal lengths 3 %
# wrong gain 3.5 to 9, and 12 to 150 % of the score. Principal points 2 % of the image width beside (13 to 26 px) gain 3.5 to 4 on
# average; those that gain little are rotations. Offsets of 50 ms gain 3 to 9 and 8 to 280 % where speeds differ (KITTI drive
# 0005, HDL-32E and OS1-128 in a bend), and right clocks at most 1.0 and 0.7 %.
CLEARLY, LEAST_SHARE, MIN_FRAMES = 2.5, 0.05, 3
TIME_OFFSETS_S = (-0.1, -0.075, -0.05, -0.025, 0.025, 0.05, 0.075, 0.1)  # up to one scan at 10 Hz


@dataclass(frozen=True, eq=False)
class Effect:
    """How an unknown moves the optimum.

    direction: (6,) twist of the optimum, rad and m, per unit of the unknown. information: what the scenes tell of the unknown,
    the inverse of its variance.
    """

    direction: Matrix
    information: float

    def sigma(self, prior: float) -> float:
        """Standard deviation of the unknown, if it is `prior` in advance."""
        return float(1 / np.sqrt(self.information + 1 / prior**2)) if prior > 0 else 0.0

    def covariance(self, prior: float) -> Matrix:
        """(6, 6), what the unknown leaves open of the extrinsic. prior: its standard deviation in advance."""
        shift = self.sigma(prior) * self.direction
        return np.outer(shift, shift)

    def within(self, constraints: PoseConstraints, covariance: Matrix, prior: float) -> Effect:
        """The same for an extrinsic of which something is known in advance: its prior holds the optimum back, and its limits end
        its way. covariance: (6, 6) of the optimum, its prior counted."""
        direction = self.direction
        if constraints.prior:
            direction = direction - covariance @ (constraints.information() * direction)
        sigma = self.sigma(prior)
        farthest = constraints.limits.half / sigma if sigma else np.full(6, np.inf)
        return replace(self, direction=np.clip(direction, -farthest, farthest))


@dataclass(frozen=True, eq=False)
class Nuisance:
    """What intrinsics and clocks leave open of an optimum. covariance: (6, 6). clocks: effect of an offset as large as
    motion.max_time_offset_s; None where the motion is not known."""

    covariance: Matrix
    clocks: Effect | None = None


def nuisance_covariance(
    features: Sequence[FrameFeatures],
    score: PointScore,
    T: Matrix,
    covariance: Matrix,
    constraints: PoseConstraints,
    config: Config,
    offset_sigma_s: float,
    clocks: Effect | None = None,
) -> Nuisance:
    """What intrinsics and clocks leave open of the optimum T (4, 4) of these features, whose own covariance is (6, 6).

    offset_sigma_s: standard deviation of the clocks' offset, before these scenes or after them. clocks: effect of the offset, if
    it is known.
    """
    active = constraints.active_limits(T, score.at(-1).linearise(T)[0])  # not at its maximum along these
    limits = replace(constraints.limits, half=np.where(active, 0.0, constraints.limits.half))
    shared = np.zeros((6, 6))
    if not limits.open_axes.any():
        return Nuisance(shared)
    sigma = config.camera.focal_sigma
    if sigma and not score.camera.is_cylinder:
        shared += focal_effect(score, T, limits).within(constraints, covariance, sigma).covariance(sigma)
    moving = with_known_motion(features, score)
    if moving is None:
        return Nuisance(shared)
    told = clocks is not None
    if clocks is None or active.any():  # else it is that of the same optimum
        clocks = time_effect(moving[0], T, limits, moving[1])
    given = replace(clocks, information=0.0) if told else clocks  # these scenes count only once
    shared += given.within(constraints, covariance, offset_sigma_s).covariance(offset_sigma_s)
    return Nuisance(shared, clocks.within(constraints, covariance, config.motion.max_time_offset_s))


def with_known_motion(features: Sequence[FrameFeatures], score: PointScore) -> tuple[PointScore, Matrix] | None:
    """The part of a score whose frames have a known velocity of the LiDAR, and these, (n_frames, 6) rad/s and m/s, 0 for the
    others; None if there is none."""
    known = np.array([f.twist is not None for f in features])
    twists = np.array([np.zeros(6) if f.twist is None else f.twist for f in features])
    points = known[score.frame]
    if not points.any():
        return None
    return (score if points.all() else score.select(points)), twists


def focal_effect(score: PointScore, T: Matrix, limits: Limits) -> Effect:
    """The effect of the focal length, as a share of it, on the optimum T (4, 4)."""
    return _effect(score, T, limits, lambda part, x: (part.with_intrinsics(x, 0.0, 0.0), T), FOCAL_STEP)


def time_effect(score: PointScore, T: Matrix, limits: Limits, twists: Matrix, points: int = NEAR_POINTS) -> Effect:
    """The effect of the clocks' offset, s, on the optimum T (4, 4). twists: (n_frames, 6) of the LiDAR, rad/s and m/s. points:
    edge points used at most.

    What all frames have in common of their motion only moves the optimum, and tells nothing of the offset.
    """
    if not twists.any():
        return Effect(np.zeros(6), 0.0)
    return _effect(score, T, limits, lambda part, x: shifted(part, T, twists, x), TIME_STEP_S, points)


def check_times(score: PointScore, T: Matrix, limits: Limits, twists: Matrix) -> WrongTimes | None:
    """Why the clocks do not fit, None if they do or too few frames tell. twists: as `time_effect`; without an offset of their own
    where the vehicle does not move."""
    if len(np.unique(score.frame)) < MIN_FRAMES or not limits.open_axes.any() or not twists.any():
        return None
    best = best_alternative(score, T, limits, TIME_OFFSETS_S, lambda part, x: shifted(part, T, twists, x))
    return WrongTimes(best.value, best.gain) if best is not None and best.significant else None


def shifted(score: PointScore, T: Matrix, twists: Matrix, seconds: float) -> Changed:
    """The score with an offset of the clocks, s, and where its optimum is if T (4, 4) is the one without: what all frames have in
    common of their motion turns the extrinsic back."""
    weight = np.bincount(score.frame, score.weights, len(twists))
    common = weight @ twists / weight.sum()
    return score.moved(twists, seconds), T @ se3.exp(-common * seconds)


def _effect(
    score: PointScore,
    T: Matrix,
    limits: Limits,
    changed: Callable[[PointScore, float], Changed],
    step: float,
    points: int = NEAR_POINTS,
) -> Effect:
    """Refined anew with the unknown a step to either side: where the optimum goes, and by how much the score falls."""
    limits = Limits(T, np.where(limits.open_axes, np.inf, 0.0))  # at speed, a step is farther than a leash
    part = score.subset(points, np.random.default_rng(0))
    ends, values = zip(
        *(refined(*changed(part, x), limits, NEAR_LEVELS, NEAR_TOLERANCE_DEG) for x in (-step, 0.0, step)), strict=True
    )
    direction = np.where(limits.open_axes, se3.log(ends[2] @ se3.inverse(ends[0])), 0.0) / (2 * step)
    fallen = max(values[1] - 0.5 * (values[0] + values[2]), 0.0)
    return Effect(direction, 2 * fallen / step**2 / noise_of(part, T, limits))


@dataclass(frozen=True, eq=False)
class Alternative(Generic[Value]):
    """The value of an unknown with the best match. gain: by how much its score exceeds that of the given one, in standard
    deviations. share: the same, as a share of the score."""

    value: Value
    gain: float
    share: float

    @property
    def significant(self) -> bool:
        """True if it is clearly better."""
        return self.gain > CLEARLY and self.share > LEAST_SHARE


def best_alternative(
    score: PointScore, T: Matrix, limits: Limits, values: Iterable[Value], changed: Callable[[PointScore, Value], Changed]
) -> Alternative[Value] | None:
    """Compare the match at the optimum T (4, 4) with that of other values of an unknown, each at its own optimum; None if none is
    better.

    limits: axes that are fixed stay so. changed: the score with such a value, and where to begin.
    """
    # Around where it begins, not within a search's bounds: near one of them only other values could go on.
    reach = np.where(limits.open_axes, REACH, 0.0)
    part = score.subset(POINTS, np.random.default_rng(0))
    # Coarse levels may have their optimum elsewhere.
    here = max(refined(part, T, Limits(T, reach), LEVELS, TOLERANCE_DEG)[1], part.at(-1).value(T))
    best, highest = None, here
    for value in values:
        other, start = changed(part, value)
        start = Limits(T, np.where(limits.open_axes, np.inf, 0.0)).clip(start)
        reached = refined(other, start, Limits(start, reach), LEVELS, TOLERANCE_DEG)[1]
        if reached > highest:
            best, highest = value, reached
    if best is None:
        return None
    gain = highest - here
    return Alternative(best, float(np.sqrt(2 * gain / noise_of(part, T, limits))), gain / max(abs(here), NO_NOISE))


def noise_of(score: PointScore, T: Matrix, limits: Limits) -> float:
    """Noise of the score at its optimum T (4, 4): twice what is lost by one standard deviation; see `noise_level`."""
    level, axes = score.n_levels - 1, np.flatnonzero(limits.open_axes)
    return max(noise_level(score, T, level, noise_covariance(score, T, level, axes, noise=1.0), axes), NO_NOISE)


def refined(score: PointScore, T: Matrix, limits: Limits, levels: tuple[int, ...], tolerance_deg: float) -> tuple[Matrix, float]:
    """The optimum (4, 4) near T and its score."""
    T, value = limits.clip(T), 0.0
    for level in levels:
        T, value = levenberg_marquardt(score.at(level), T, limits=limits, tolerance_deg=tolerance_deg, near=True)
    return T, value

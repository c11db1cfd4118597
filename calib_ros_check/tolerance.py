"""From an estimate with its covariance to a verdict about a tolerance.

How wrong an extrinsic is follows from the estimate and from what is plausible in advance: errors of all orders of magnitude, from
a sixteenth of the tolerance to far beyond it, are taken to be equally probable, rotation and translation each for themselves.
With an estimate that is much more accurate than the tolerance this prior has no influence; with one that is not, it keeps noise
from being called an error, as it keeps an error from being called noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import scipy

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.registration.judgement.judge import CONFIDENCE, EVEN, Match, convinces, evidence, log_odds
from calib_ros.registration.judgement.refusal import joined
from calib_ros.registration.search.constraints import Limits
from calib_ros.registration.search.optimizers import LEVELS, NEAR_LEVELS, POINTS, TOLERANCE_DEG, refined
from calib_ros_check.outcome import CauseFinding, CheckVerdict, Deviation, Tolerance

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
TITLES = dict(zip(AXES, ("pitch", "yaw", "roll", "sideways", "height", "forward"), strict=True))
# Scales of the prior, as multiples of the tolerance.
SCALES = 2.0 ** np.arange(-4, 9)
SAMPLES = 20000
QUANTILES = (np.arange(8) + 0.5) / 8  # of the variances that make up Student's distribution
ACCUSATION = 0.01  # largest probability that what is accused is right
INTERVAL = 0.95
NEAREST_ROUNDS = 50  # of the fixed point
MORE_FRAMES = "use more frames of other scenes"
FLIPPED_DEG = 135.0  # an error above it is nearer to the opposite direction than to a quarter turn, as cameras are mounted
# By axis: what a positive and what a negative error means, and one above FLIPPED_DEG. A positive rotation about y, which points
# down, moves all points to the right in the image: the camera is taken to look further left than it does.
DIRECTIONS = {
    "rx": ("camera looks {} too far down", "camera looks {} too far up", "camera looks backwards, turned over by {}"),
    "ry": ("camera looks {} too far left", "camera looks {} too far right", "camera looks backwards, turned by {}"),
    "rz": ("camera is rolled {} too far anticlockwise", "camera is rolled {} too far clockwise", "camera is upside down, by {}"),
    "tx": ("camera is {} too far left", "camera is {} too far right"),
    "ty": ("camera is {} too high", "camera is {} too low"),
    "tz": ("camera is {} too far back", "camera is {} too far ahead"),
}
# The extrinsic with a cause that was found mended, as far as a check can do that.
_THEN = {
    CheckVerdict.PASS: "with that mended, the extrinsic is right: {sizes}",
    CheckVerdict.INCONCLUSIVE: "with that mended, the scenes do not tell whether it is right to within {limits}: {sizes}",
    CheckVerdict.FAIL: "even with that mended the extrinsic seems to be off by more than {limits}, {sizes}; so the cause "
    "may be another or not the only one: mend it and check again",
}
DEGREES = np.array([np.rad2deg(1.0)] * 3 + [1.0] * 3)


@dataclass(frozen=True, eq=False)
class Judgement:
    """What is known of the error of an extrinsic. p_within: probability that it is within the tolerance."""

    verdict: CheckVerdict
    p_within: float
    rotation: Deviation
    translation: Deviation
    axes: tuple[Deviation, ...]

    @property
    def sizes(self) -> str:
        """Of rotation and translation, in words."""
        return f"rotation {self.rotation.words}, translation {self.translation.words}"


def unknown() -> Judgement:
    """Where the scenes show no extrinsic at all."""
    nothing = CheckVerdict.INCONCLUSIVE
    rotation, translation, *axes = (Deviation(name, nothing, words="not known") for name in ("rotation", "translation", *AXES))
    return Judgement(nothing, math.nan, rotation, translation, tuple(axes))


def judge(
    T_checked: Transform,
    T_estimated: Transform,
    covariance: Covariance,
    tolerance: Tolerance,
    freedom: float = math.inf,
    shared: Covariance | None = None,
) -> Judgement:
    """Verdict about T_checked (4, 4), from an estimate of the true one (4, 4) and its covariance (6, 6), of a left twist.

    freedom: degrees of freedom of the covariance. shared: (6, 6), the part of it that the clocks, or a lens that was
    mended, leave open; more scenes would not help, so that they need not show it.
    """
    error, C = deviation(T_checked, T_estimated, covariance)
    samples = posterior_samples(error, C, tolerance, freedom)
    limits = np.array([np.deg2rad(tolerance.deg)] * 3 + [tolerance.m] * 3)
    sizes = np.stack([np.linalg.norm(samples[:, :3], axis=1), np.linalg.norm(samples[:, 3:], axis=1)], axis=1)
    p_within = float((sizes <= limits[[0, 3]]).all(axis=1).mean())
    # Axes share the scale of the prior; what is known of one must not stand for another that the scenes do not show. And what is
    # rare in advance must not hide an error that is seen.
    own = C if shared is None else deviation(T_checked, T_estimated, covariance - shared)[1]
    shown = np.sqrt(np.maximum(np.diag(own), 0)) <= limits
    seen = np.r_[error, np.linalg.norm(error[:3]), np.linalg.norm(error[3:])]
    names, bounds = (*AXES, "rotation", "translation"), np.r_[limits, limits[[0, 3]]]
    known = np.r_[shown, shown[:3].all(), shown[3:].all()] & (np.abs(seen) <= bounds)
    units, drawn = np.r_[DEGREES, DEGREES[[0, 3]]], np.hstack([samples, sizes])
    *axes, rotation, translation = (_deviation(*own) for own in zip(names, drawn.T, seen, bounds, units, known, strict=True))
    return Judgement(verdict_of(p_within, bool(known.all())), p_within, rotation, translation, tuple(axes))


def undecided(judgement: Judgement) -> Judgement:
    """The same where nothing is said to fail."""
    opened = {own: own for own in CheckVerdict} | {CheckVerdict.FAIL: CheckVerdict.INCONCLUSIVE}
    parts = (judgement.rotation, judgement.translation, *judgement.axes)
    rotation, translation, *axes = (replace(own, verdict=opened[own.verdict]) for own in parts)
    return Judgement(opened[judgement.verdict], judgement.p_within, rotation, translation, tuple(axes))


def verdict_of(p_within: float, known: bool) -> CheckVerdict:
    """The verdict by the probability that an error is within the tolerance. known: the estimate alone is so, and its standard
    deviation is less than that."""
    if p_within >= CONFIDENCE:
        return CheckVerdict.PASS if known else CheckVerdict.INCONCLUSIVE
    return CheckVerdict.FAIL if p_within <= ACCUSATION else CheckVerdict.INCONCLUSIVE


def is_off(optimum: Match, covariance: Covariance, T_checked: Transform, tolerance: Tolerance) -> bool:
    """Whether an optimum convinces against every extrinsic within the tolerance of T_checked (4, 4). Its covariance (6, 6) tells
    where the best of these is, but knows one top of the score only."""
    part = optimum.score.subset(POINTS, np.random.default_rng(0))
    half = np.array([np.deg2rad(tolerance.deg)] * 3 + [tolerance.m] * 3)
    # The twist within both limits that is nearest by the covariance: by the limits' multipliers, found as a fixed point.
    twist = error = se3.log(optimum.T @ se3.inverse(T_checked))
    information, multipliers = np.linalg.inv(covariance), half**-2.0
    for _ in range(NEAREST_ROUNDS):
        twist = np.linalg.solve(information + np.diag(multipliers), information @ error)
        sizes = np.repeat(np.linalg.norm(twist.reshape(2, 3), axis=1), 3)
        multipliers = np.maximum(multipliers, 1e-12) * (sizes / half) ** 2
    nearest = se3.exp(twist * min(1.0, float((half / np.maximum(sizes, 1e-12)).min()))) @ T_checked
    limits, ends = Limits(T_checked, half / np.sqrt(3)), [nearest]
    for start, levels in product((T_checked, limits.clip(nearest)), (LEVELS, NEAR_LEVELS)):
        ends.append(refined(part, start, limits, levels, TOLERANCE_DEG)[0])
    best = max((Match(part, T) for T in ends), key=evidence)
    return convinces(log_odds(Match(part, optimum.T), best), EVEN)


def deviation(T_checked: Transform, T_estimated: Transform, covariance: Covariance) -> tuple[Matrix, Matrix]:
    """Error (6,) of T_checked against T_estimated (4, 4) as `CheckResult.axes`, rad and m, and its covariance (6, 6), from that
    of a left twist of T_estimated."""
    turn = se3.rotation_vector(T_checked[:3, :3] @ T_estimated[:3, :3].T)
    error = np.concatenate([turn, T_checked[:3, 3] - T_estimated[:3, 3]])
    A = se3.parts_jacobian(T_estimated)
    return error, A @ covariance @ A.T


def posterior_samples(error: Matrix, C: Matrix, tolerance: Tolerance, freedom: float = math.inf) -> Matrix:
    """Samples (n, 6) of the true error, given its estimate (6,) and covariance (6, 6), by so many degrees of freedom: errors of
    Student's distribution are normal ones of several covariances.

    The prior is a mixture of normal distributions, whose posterior is one as well: a Kalman update per component, weighted by how
    well the component predicts the estimate. Deterministic.
    """
    variances = [[turn**2] * 3 + [shift**2] * 3 for turn in np.deg2rad(tolerance.deg) * SCALES for shift in tolerance.m * SCALES]
    noises = freedom / (2 * scipy.special.gammaincinv(freedom / 2, QUANTILES)) if np.isfinite(freedom) else np.ones(1)
    prior = np.tile(np.array([np.diag(own) for own in variances]), (len(noises), 1, 1))
    noise = np.repeat(noises, len(variances))[:, None, None] * C
    L = np.linalg.cholesky(noise + prior)
    whitened = np.linalg.solve(L, np.broadcast_to(error[:, None], (len(L), 6, 1)))[..., 0]
    logs = -0.5 * np.sum(whitened**2, axis=1) - np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
    gain = np.swapaxes(np.linalg.solve(noise + prior, prior), 1, 2)
    left = np.eye(6) - gain
    after = left @ prior @ np.swapaxes(left, 1, 2) + gain @ noise @ np.swapaxes(gain, 1, 2)
    means, roots = gain @ error, np.linalg.cholesky(after + 1e-18 * np.eye(6))
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    component = np.searchsorted(np.cumsum(weight), (np.arange(SAMPLES) + 0.5) / SAMPLES * (1 - 1e-12))
    normal = np.random.default_rng(0).standard_normal((SAMPLES, 6))
    return np.asarray(means[component] + np.einsum("nij,nj->ni", roots[component], normal))


def _deviation(name: str, samples: Matrix, seen: float, limit: float, unit: float, known: bool) -> Deviation:
    """seen: by the estimate alone, which lies in the interval as well."""
    tail = (1 - INTERVAL) / 2
    low, error, high = unit * np.quantile(samples, [tail, 0.5, 1 - tail])
    low, error, high = float(min(low, unit * seen)), float(error), float(max(high, unit * seen))
    verdict, is_angle = verdict_of(float((np.abs(samples) <= limit).mean()), known), name[0] == "r"
    # Direction and size of the error along an axis; what is claimed is described, not what is true.
    if name not in AXES:
        words = f"off by {amount(error, is_angle)} ({amount(low, is_angle)} to {amount(high, is_angle)})"
    elif low <= 0 <= high and verdict is CheckVerdict.PASS:
        words = f"right within {amount(max(abs(low), abs(high)), is_angle)}"
    elif low <= 0 <= high:
        words = f"between {signed(low, is_angle)} and {signed(high, is_angle)}"
    else:
        spread, flipped = amount(max(high - error, error - low), is_angle), is_angle and abs(error) > FLIPPED_DEG
        way = DIRECTIONS[name][2 if flipped else int(error < 0)]
        within = ", within the tolerance" if verdict is CheckVerdict.PASS else ""
        words = f"{way.format(amount(error, is_angle))} (+- {spread}){within}"
    return Deviation(name, verdict, error, low, high, words)


def reason_of(
    judgement: Judgement, tolerance: Tolerance, cause: CauseFinding | None, possible: Sequence[CauseFinding] = ()
) -> str:
    """The verdict for people, as of `Result`: what is wrong, then figures."""
    if cause is not None:
        return joined([cause.message, _THEN[judgement.verdict].format(limits=tolerance, sizes=judgement.sizes)])
    if judgement.verdict is CheckVerdict.PASS:
        return f"right to within {tolerance}: {judgement.sizes}"
    sizes, others = (judgement.rotation, judgement.translation), [f"or else {own.message}" for own in possible]
    # The axes that fail, or are inconclusive, or else what does so in all; those that are off first, and the largest of them.
    worst = sorted(
        (own for own in judgement.axes if own.verdict is judgement.verdict),
        key=lambda own: (not own.is_off, -abs(own.error) * (1.0 if own.name[0] == "r" else 5.0)),
    )
    if judgement.verdict is CheckVerdict.FAIL:
        in_all = sorted(sizes, key=lambda own: own.verdict is not CheckVerdict.FAIL)
        first, *more = [own.words for own in worst] or [f"{own.name} {own.words}" for own in in_all]
        return joined([f"{first}: estimate anew", *more, f"more than {tolerance}", *others])
    names = ", ".join(f"{own.name} {own.words}" for own in worst) or judgement.sizes
    known = f"not known to within {tolerance}" + " in all" * (not worst)  # each axis may be, and their length not
    if any(own.is_off for own in worst or judgement.axes):  # that the extrinsic is wrong is known, only not by how much
        largest = max(sizes, key=lambda own: own.error / (tolerance.deg if own is judgement.rotation else tolerance.m))
        known = f"off by about {amount(largest.error, largest is sizes[0])}, not surely by more than {tolerance}"
    return joined([f"{known}: {MORE_FRAMES}", names, *others])


def amount(value: float, is_angle: bool) -> str:
    """An error with its unit."""
    if is_angle:
        return f"{abs(value):.2f} deg" if abs(value) < 10 else f"{abs(value):.0f} deg"
    return f"{100 * abs(value):.1f} cm" if abs(value) < 1 else f"{abs(value):.2f} m"


def signed(value: float, is_angle: bool) -> str:
    """The same with its sign."""
    return f"{'-' if value < 0 else '+'}{amount(value, is_angle)}"

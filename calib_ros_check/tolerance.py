"""From an estimate with its covariance to a verdict about a tolerance.

How wrong an extrinsic is follows from the estimate and from what is plausible in advance: errors of all orders of magnitude, from
a sixteenth of the tolerance to far beyond it, are taken to be equally probable, rotation and translation each for themselves.
With an estimate that is much more accurate than the tolerance this prior has no influence; with one that is not, it keeps noise
from being called an error, as it keeps an error from being called noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros_check.outcome import CauseFinding, CheckVerdict, Deviation, Tolerance
from calib_ros_check.words import axis_words, size_words

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
# Scales of the prior, as multiples of the tolerance.
SCALES = 2.0 ** np.arange(-4, 9)
SAMPLES = 20000
CONFIDENCE = 0.9  # probability from which a verdict is one
INTERVAL = 0.95
MORE_FRAMES = "use more frames of other scenes, with objects in view of both sensors"
DEGREES = np.array([np.rad2deg(1.0)] * 3 + [1.0] * 3)


@dataclass(frozen=True, eq=False)
class Judgement:
    """What is known of the error of an extrinsic. p_within: probability that it is within the tolerance."""

    verdict: CheckVerdict
    p_within: float
    rotation: Deviation
    translation: Deviation
    axes: tuple[Deviation, ...]


def unknown() -> Judgement:
    """Where the scenes show no extrinsic at all."""
    nothing = CheckVerdict.INCONCLUSIVE
    return Judgement(
        nothing,
        math.nan,
        Deviation("rotation", nothing, words="not known"),
        Deviation("translation", nothing, words="not known"),
        tuple(Deviation(axis, nothing, words="not known") for axis in AXES),
    )


def judge(T_checked: Transform, T_estimated: Transform, covariance: Covariance, tolerance: Tolerance) -> Judgement:
    """Verdict about T_checked (4, 4), from an estimate of the true one (4, 4) and its covariance (6, 6), of a left twist."""
    error, C = deviation(T_checked, T_estimated, covariance)
    samples = posterior_samples(error, C, tolerance)
    limits = np.array([np.deg2rad(tolerance.deg)] * 3 + [tolerance.m] * 3)
    sizes = np.stack([np.linalg.norm(samples[:, :3], axis=1), np.linalg.norm(samples[:, 3:], axis=1)], axis=1)
    in_tolerance = sizes <= limits[[0, 3]]
    p_within = float(in_tolerance.all(axis=1).mean())
    # Axes share the scale of the prior; what is known of one must not stand for another that the scenes do not show.
    shown = np.sqrt(np.diag(C)) <= limits
    axes = tuple(
        _deviation(name, samples[:, k], float((np.abs(samples[:, k]) <= limits[k]).mean()), DEGREES[k], bool(shown[k]))
        for k, name in enumerate(AXES)
    )
    rotation = _deviation("rotation", sizes[:, 0], float(in_tolerance[:, 0].mean()), DEGREES[0], bool(shown[:3].all()))
    translation = _deviation("translation", sizes[:, 1], float(in_tolerance[:, 1].mean()), 1.0, bool(shown[3:].all()))
    return Judgement(verdict_of(p_within, bool(shown.all())), p_within, rotation, translation, axes)


def verdict_of(p_within: float, shown: bool = True) -> CheckVerdict:
    """The verdict by the probability that an error is within the tolerance. shown: its standard deviation is less than that."""
    if p_within >= CONFIDENCE:
        return CheckVerdict.PASS if shown else CheckVerdict.INCONCLUSIVE
    return CheckVerdict.FAIL if p_within <= 1 - CONFIDENCE else CheckVerdict.INCONCLUSIVE


def deviation(T_checked: Transform, T_estimated: Transform, covariance: Covariance) -> tuple[Matrix, Matrix]:
    """Error (6,) of T_checked against T_estimated (4, 4) as `CheckResult.axes`, rad and m, and its covariance (6, 6), from that
    of a left twist of T_estimated."""
    turn = Rotation.from_matrix(T_checked[:3, :3] @ T_estimated[:3, :3].T).as_rotvec()
    error = np.concatenate([turn, T_checked[:3, 3] - T_estimated[:3, 3]])
    A = se3.parts_jacobian(T_estimated)
    return error, A @ covariance @ A.T


def posterior_samples(error: Matrix, C: Matrix, tolerance: Tolerance) -> Matrix:
    """Samples (n, 6) of the true error, given its estimate (6,) and covariance (6, 6).

    The prior is a mixture of normal distributions, whose posterior is one as well: a Kalman update per component, weighted by how
    well the component predicts the estimate. Deterministic.
    """
    means, roots, logs = [], [], []
    for turn in np.deg2rad(tolerance.deg) * SCALES:
        for shift in tolerance.m * SCALES:
            prior = np.diag([turn**2] * 3 + [shift**2] * 3)
            L = np.linalg.cholesky(C + prior)
            whitened = np.linalg.solve(L, error)
            logs.append(-0.5 * whitened @ whitened - np.log(np.diag(L)).sum())
            gain = np.linalg.solve(C + prior, prior).T
            left = np.eye(6) - gain
            means.append(gain @ error)
            roots.append(np.linalg.cholesky(left @ prior @ left.T + gain @ C @ gain.T + 1e-18 * np.eye(6)))
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    component = np.searchsorted(np.cumsum(weight), (np.arange(SAMPLES) + 0.5) / SAMPLES * (1 - 1e-12))
    normal = np.random.default_rng(0).standard_normal((SAMPLES, 6))
    return np.asarray(np.array(means)[component] + np.einsum("nij,nj->ni", np.array(roots)[component], normal))


def _deviation(name: str, samples: Matrix, p_within: float, unit: float, shown: bool) -> Deviation:
    tail = (1 - INTERVAL) / 2
    low, error, high = (float(x) for x in unit * np.quantile(samples, [tail, 0.5, 1 - tail]))
    found = Deviation(name, verdict_of(p_within, shown), error, low, high)
    words = axis_words(found) if name in AXES else size_words(found)
    return Deviation(name, found.verdict, error, low, high, words)


def worst(judgement: Judgement) -> Sequence[Deviation]:
    """The axes that fail, or else those that are inconclusive; the largest first."""
    for verdict in (CheckVerdict.FAIL, CheckVerdict.INCONCLUSIVE):
        found = [axis for axis in judgement.axes if axis.verdict is verdict]
        if found:
            return sorted(found, key=lambda axis: -abs(axis.error) * (1.0 if axis.name[0] == "r" else 5.0))
    return []


def reason_of(
    judgement: Judgement, tolerance: Tolerance, cause: CauseFinding | None, possible: Sequence[CauseFinding] = ()
) -> str:
    """The verdict in one line, for people."""
    limits = f"{tolerance.deg:g} deg / {100 * tolerance.m:g} cm"
    sizes = f"rotation {judgement.rotation.words}, translation {judgement.translation.words}"
    if cause is not None:
        rest = "right" if judgement.verdict is CheckVerdict.PASS else judgement.verdict.value
        return f"{cause.message}; with that mended, the extrinsic is {rest}: {sizes}"
    if judgement.verdict is CheckVerdict.PASS:
        return f"right to within {limits}: {sizes}"
    axes = [axis.words for axis in worst(judgement)]
    if judgement.verdict is CheckVerdict.FAIL:
        return "; ".join([f"{'; '.join(axes) or sizes}: more than {limits}", *(f"or else {own.message}" for own in possible)])
    names = ", ".join(f"{axis.name} {axis.words}" for axis in worst(judgement)) or sizes
    return f"the scenes do not tell it to within {limits}: {names}; {MORE_FRAMES}"

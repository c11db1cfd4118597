"""Selections and statistics of trials and curves that several tables and plots share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, mannwhitneyu

from calib_ros_evaluation.curves import Curves
from calib_ros_evaluation.methods.edges import fitted, probability_right
from calib_ros_evaluation.results import END, SUCCESS_DEG, SUCCESS_M, Results, Trust

Matrix = NDArray[np.float64]
OURS = "ours"  # name of this project's method
FALSE_ALARMS = 0.05  # of detections by the share of worse neighbours
RISE = 0.01  # of a curve's span; what falls less between two samples still counts as rising


def wilson(successes: int, n: int) -> tuple[float, float]:
    """95 % interval of a share, 0..1; unlike the textbook's it stays within 0..1 and is right for few trials."""
    found = binomtest(int(successes), int(n)).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def quantile(values: ArrayLike, share: float) -> float:
    """Of values (n,), between samples by a straight line. What is not a number counts as infinitely large, not as absent: a
    method must not look better by failing. NaN without values."""
    ordered = np.sort(np.where(np.isnan(v := np.asarray(values, float).ravel()), np.inf, v))
    if not len(ordered):
        return math.nan
    at = share * (len(ordered) - 1)
    low, high = ordered[math.floor(at)], ordered[math.ceil(at)]
    return float(low if low == high else low + (at - math.floor(at)) * (high - low))


def median(values: ArrayLike) -> float:
    """As quantile()."""
    return quantile(values, 0.5)


def mean(values: Iterable[float]) -> float:
    """Of what is finite; NaN if nothing is."""
    kept = [v for v in values if math.isfinite(v)]
    return float(np.mean(kept)) if kept else math.nan


def axis_errors(trials: pd.DataFrame) -> Matrix:
    """(n, 6) signed errors at the end, deg and cm; trials without a finite end are left out."""
    ends = trials[END].to_numpy(float)
    return np.asarray(ends[np.isfinite(ends).all(axis=1)] * ([1] * 3 + [100] * 3))


def peak_distances(curves: Curves) -> Matrix:
    """(6,) distance of each peak from the truth, deg and cm; NaN where a score is not finite. A flat curve
    counts as if its peak were at its end."""
    distance = np.where(np.isnan(curves.peaks), np.abs(curves.offsets).max(axis=1), np.abs(curves.peaks))
    return np.asarray(np.where(np.isfinite(curves.values).all(axis=1), distance, np.nan))


def basins(curves: Curves) -> Matrix:
    """(6,) how far from the truth, mean of both sides in deg and cm, each curve still rises towards its peak.

    It ends where a sample farther out is higher than the lowest one nearer the peak by RISE of the span. A side whose rise ends
    beyond the truth counts as 0, a curve without a span as well.
    """
    return np.array([_basin(x, y) for x, y in zip(curves.offsets, curves.values, strict=True)])


def _basin(x: Matrix, y: Matrix) -> float:
    if not np.isfinite(y).all():
        return math.nan
    span, peak = float(np.ptp(y)), int(np.argmax(y))
    if span <= 1e-12:
        return 0.0
    right = peak + _falling(y[peak:], RISE * span)
    left = peak - _falling(y[peak::-1], RISE * span)
    return 0.5 * (max(float(x[right]), 0.0) + max(-float(x[left]), 0.0))


def _falling(y: Matrix, tolerance: float) -> int:
    """Position up to which y (n,) falls from its first value."""
    rises = np.flatnonzero(y[1:] > np.minimum.accumulate(y)[:-1] + tolerance)
    return int(rises[0]) if len(rises) else len(y) - 1


def area(right: Matrix, wrong: Matrix) -> float:
    """Probability that a wrong one has the lower share, ties counted half."""
    return float(mannwhitneyu(right, wrong, method="asymptotic").statistic / (len(right) * len(wrong)))


def hits(right: Matrix, wrong: Matrix) -> float:
    """Share of wrong ones below the threshold that FALSE_ALARMS of the right ones are below."""
    return float(np.mean(np.sort(right)[int(FALSE_ALARMS * len(right))] > wrong))


def called_right(trusts: Sequence[Trust], size: tuple[float, float] | None) -> float:
    """Share of frames, at an error of this size (None = no error), that are classified as right; each by distributions fitted to
    all others. NaN for fewer than three frames."""
    if len(trusts) < 3:
        return math.nan
    said: list[bool] = []
    for k, own in enumerate(trusts):
        others = [*trusts[:k], *trusts[k + 1 :]]
        R, W = fitted([t.right for t in others]), fitted([share for t in others for _, _, share in t.wrong])
        shares = [own.right] if size is None else [share for deg, m, share in own.wrong if (deg, m) == size]
        said += [probability_right([share], R, W) > 0.5 for share in shares]
    return float(np.mean(said))


def trials_of(results: Results, experiment: str) -> dict[str, pd.DataFrame]:
    """Method -> its trials of an experiment; methods without any are left out."""
    own = extended(results.trials[results.trials.experiment == experiment])
    found = {name: own[own.method == name] for name in results.titles}
    return {name: trials for name, trials in found.items() if len(trials)}


def extended(trials: pd.DataFrame) -> pd.DataFrame:
    """With size: (start_deg, start_m), n: number of frames, cm: translation_m in cm, start_success: the start is within the
    limits of success already."""
    near = (trials.start_rotation_deg < SUCCESS_DEG) & (trials.start_translation_m < SUCCESS_M)
    n = trials.frames.map(lambda text: len(text.split()))
    sizes = pd.Series(list(zip(trials.start_deg, trials.start_m, strict=True)), trials.index, object)
    return trials.assign(size=sizes, n=n, cm=100 * trials.translation_m, start_success=near)


def groups(trials: dict[str, pd.DataFrame], key: str) -> tuple[list[Any], dict[str, dict[Any, pd.DataFrame]]]:
    """The values of a column, numbers ascending, and for each method its trials by each of them, which may be none."""
    values = list(dict.fromkeys(value for own in trials.values() for value in own[key]))
    values = values if key == "scene" else sorted(values)
    return values, {
        name: {value: own[[own_value == value for own_value in own[key]]] for value in values} for name, own in trials.items()
    }


def curves_of_scenes(results: Results) -> dict[str, dict[str, Curves]]:
    """Label of a scene -> method -> curves."""
    found: dict[str, dict[str, Curves]] = {}
    for one in results.curves:
        found.setdefault(one.label, {})[one.method] = one.curves
    return found


def curves_of_methods(results: Results) -> dict[str, list[Curves]]:
    """Method -> curves of all its scenes; methods without any are left out."""
    found = {name: [one.curves for one in results.curves if one.method == name] for name in results.titles}
    return {name: curves for name, curves in found.items() if curves}

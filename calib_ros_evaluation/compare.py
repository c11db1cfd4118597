"""Two evaluations of the same trials, compared pair by pair: did a change make a method better?"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import norm, t

from calib_ros.errors import BadInputError
from calib_ros_evaluation.report.table import Table
from calib_ros_evaluation.results import IDENTITY

Matrix = NDArray[np.float64]
CONFIDENCE = 0.95
BETTER, WORSE, SAME = "better", "worse", "no difference shown"
FEW_CLUSTERS = 5  # from so many on, intervals hold what they promise for normal values; see interval()
HEADER = ("experiment", "method", "trials", "measure", "A", "B", "B - A", "95 % interval", "verdict")


class Measure(NamedTuple):
    """column: of trials. kind: mean, median, or ratio: the exponential of the mean of logarithms. sign: 1 if more is better."""

    name: str
    column: str
    kind: str
    sign: int
    form: str
    change: str
    unit: float


MEASURES = {
    "rotation_mean": Measure("rotation error, mean, deg", "rotation_deg", "mean", -1, "{:.3f}", "{:+.3f}", 1.0),
    "rotation_median": Measure("rotation error, median, deg", "rotation_deg", "median", -1, "{:.3f}", "{:+.3f}", 1.0),
    "translation_mean": Measure("translation error, mean, cm", "translation_m", "mean", -1, "{:.1f}", "{:+.1f}", 100.0),
    "translation_median": Measure("translation error, median, cm", "translation_m", "median", -1, "{:.1f}", "{:+.1f}", 100.0),
    "success": Measure("success, %", "success", "mean", 1, "{:.1f}", "{:+.1f}", 100.0),
    "cpu": Measure("CPU time, geometric mean, s", "cpu_s", "ratio", -1, "{:.3g}", "x {:.2f}", 1.0),
}


class PairedChange(NamedTuple):
    """One measure in both. a, b: what it is over all pairs. change: b - a, or b / a. low, high: 95 % interval of the change, NaN
    for one cluster. clusters: sets of frames in it. verdict: BETTER or WORSE if the interval leaves out no change, else SAME."""

    a: float
    b: float
    change: float
    low: float
    high: float
    clusters: int
    verdict: str


class Comparison(NamedTuple):
    """One method in one experiment, B against A. pairs: trials in both; only_a, only_b: in one of them. gained, lost: trials that
    succeed in B only, in A only. estimates: of MEASURES, over the pairs where both are numbers; errors in deg and m, success as a
    share, CPU s."""

    experiment: str
    method: str
    pairs: int
    only_a: int
    only_b: int
    gained: int
    lost: int
    estimates: dict[str, PairedChange]


def compare(a: pd.DataFrame, b: pd.DataFrame, seed: int = 0, resamples: int = 2000) -> list[Comparison]:
    """A comparison for every experiment and method in a or b, by name; trials are pairs if they agree in IDENTITY.

    Intervals are from `resamples` bootstrap samples of the sets of frames (trials on the same frames are not independent). The
    order of trials does not matter. BadInputError that says in what they differ if there is no pair.
    """
    both = a.merge(b, how="outer", on=list(IDENTITY), suffixes=("_a", "_b"), indicator="which")
    if not (both.which == "both").any():
        raise BadInputError(f"the tables have no trial in common: {_apart(a, b)}; evaluate both with the same options")
    # By number: 2 before 10.
    both = both.sort_values(
        list(IDENTITY), key=lambda c: c.map(lambda text: tuple(map(int, text.split()))) if c.name == "frames" else c
    )
    found = []
    for (experiment, method), own in both.groupby(["experiment", "method"]):
        pairs = own[own.which == "both"]
        frames = list(zip(pairs.scene, pairs.frames, strict=True))
        estimates = {}
        for name, one in MEASURES.items():
            values = pairs[[f"{one.column}_a", f"{one.column}_b"]].to_numpy(float)
            estimates[name] = paired_change(values, frames, one.kind, one.sign, seed, resamples)
        counts = len(pairs), int((own.which == "left_only").sum()), int((own.which == "right_only").sum())
        more = pairs.success_b - pairs.success_a
        found.append(Comparison(experiment, method, *counts, int((more > 0).sum()), int((more < 0).sum()), estimates))
    return found


def paired_change(
    values: Matrix, frames: Sequence[Hashable], kind: str, sign: int, seed: int = 0, resamples: int = 2000
) -> PairedChange:
    """values: (n, 2) in A and B; pairs with one that is not finite are left out. frames: of each pair, alike within a cluster.
    kind, sign: as of Measure."""
    if kind == "ratio":
        with np.errstate(divide="ignore", invalid="ignore"):
            values = np.log(values)
    valid = np.flatnonzero(np.isfinite(values).all(axis=1))
    if not len(valid):
        return PairedChange(np.nan, np.nan, np.nan, np.nan, np.nan, 0, SAME)
    a, b = values[valid].T
    numbers: dict[Hashable, int] = {}
    cluster = np.array([numbers.setdefault(frames[i], len(numbers)) for i in valid.tolist()])
    drawn = draws(len(numbers), seed, resamples)
    middle = np.median if kind == "median" else np.mean
    of_a, of_b = float(middle(a)), float(middle(b))
    low, high = np.nan, np.nan
    if len(numbers) > 1:
        samples = medians(b, cluster, drawn) - medians(a, cluster, drawn) if kind == "median" else means(b - a, cluster, drawn)
        low, high = interval(samples, len(numbers))
    verdict = SAME
    if low > 0 or high < 0:
        verdict = BETTER if (low > 0) == (sign > 0) else WORSE
    change = of_b - of_a if kind == "median" else float(np.mean(b - a))
    if kind == "ratio":
        of_a, of_b, change, low, high = map(float, np.exp([of_a, of_b, change, low, high]))
    return PairedChange(of_a, of_b, change, low, high, len(numbers), verdict)


def _apart(a: pd.DataFrame, b: pd.DataFrame) -> str:
    """The first column of IDENTITY in which trials that agree in those before differ, with a few values of both."""
    n = next(n for n in range(len(IDENTITY)) if a.merge(b, on=list(IDENTITY[: n + 1])).empty)
    before, name = list(IDENTITY[:n]), IDENTITY[n]
    common = a.merge(b, on=before)[before] if before else None
    said, most = [], 3
    for own in (a, b):
        texts = sorted(set(map(str, (own if common is None else own.merge(common))[name])))
        said.append((", ".join(texts[:most]) or "missing") + (f" and {len(texts) - most} more" if len(texts) > most else ""))
    return f"{name} is {said[0]} in A, {said[1]} in B"


def as_text(comparisons: Sequence[Comparison], name_a: str, name_b: str) -> str:
    """An aligned table for a terminal, with notes below."""
    rows, notes = [], []
    for c in comparisons:
        for n, (key, one) in enumerate(MEASURES.items() if c.pairs else ()):  # a note says which have none
            e = c.estimates[key]
            a, b = (_text(one.form, value * one.unit) for value in (e.a, e.b))
            change, low, high = (_text(one.change, value * one.unit) for value in (e.change, e.low, e.high))
            name = f"{one.name} ({c.gained} gained, {c.lost} lost)" if key == "success" else one.name
            head = ["", "", ""] if n else [c.experiment, c.method, str(c.pairs)]
            verdict = e.verdict + (" *" if e.clusters < FEW_CLUSTERS else "")
            rows.append([*head, name, a, b, change, "-" if low == "-" else f"{low} .. {high}", verdict])
    if any(row[-1].endswith("*") for row in rows):
        notes.append(f"* the interval is not reliable: fewer than {FEW_CLUSTERS} sets of frames; evaluate more frames")
    for side, only in (("A", [c.only_a for c in comparisons]), ("B", [c.only_b for c in comparisons])):
        which = ", ".join(f"{n} of {c.experiment} {c.method}" for n, c in zip(only, comparisons, strict=True) if n)
        notes += [f"Only in {side}, not compared: {which}"] if which else []
    return "\n".join([f"A: {name_a}", f"B: {name_b}", "", Table("", HEADER, rows).text(), "", *NOTES, *notes])


NOTES = (
    "Intervals: bootstrap of whole sets of frames. Of 20 rows without a real difference, one shows one by chance.",
    "A few wild trials move a mean, and make its interval too narrow; medians are safe from them.",
    "CPU times compare only if both evaluations ran on the same machine, equally busy.",
)


def _text(form: str, value: float) -> str:
    return form.format(value) if np.isfinite(value) else "-"


def draws(clusters: int, seed: int, resamples: int) -> NDArray[np.int32]:
    """(resamples, clusters) how often each cluster is drawn, with replacement: values of one cluster are not independent, so that
    samples are of whole clusters (Davison and Hinkley 1997, sections 3.8 and 5.3). The same seed draws the same of as many."""
    return np.random.default_rng(seed).multinomial(clusters, np.full(clusters, 1 / clusters), resamples).astype(np.int32)


def means(values: Matrix, cluster: NDArray[np.intp], drawn: NDArray[np.int32]) -> Matrix:
    """Mean of values (n,) in every sample, (resamples,). cluster: (n,) number of each value's cluster."""
    return np.asarray((drawn @ np.bincount(cluster, values)) / (drawn @ np.bincount(cluster)))


def medians(values: Matrix, cluster: NDArray[np.intp], drawn: NDArray[np.int32]) -> Matrix:
    """As `means`, the median."""
    return np.array([np.median(np.repeat(values, row[cluster])) for row in drawn])


def interval(samples: Matrix, clusters: int) -> tuple[float, float]:
    """Expanded percentile interval of a statistic from its values (resamples,) in the samples of at least 2 clusters.

    Plain percentiles are too narrow for few clusters, by sqrt((n - 1) / n) and by what Student's t is wider than the normal
    distribution (Hesterberg 2015, What Teachers Should Know About the Bootstrap, section 5.3). Measured on 5 to 50 clusters of
    5 values, they hold the true value 92 to 95 times in 100 (plain ones 84 to 94) for normal values, and for means of
    log-normal ones only 79 to 89 times; for their medians 93 to 96.
    """
    tail = norm.cdf(-np.sqrt(clusters / (clusters - 1)) * t.ppf((1 + CONFIDENCE) / 2, clusters - 1))
    low, high = np.quantile(samples, [tail, 1 - tail])
    return float(low), float(high)

"""When did an extrinsic change? Segments of constant extrinsic in a sequence of estimates with known covariances.

The sequence is divided where that explains it better by more than a penalty per change: the optimal partitioning of Jackson et
al. (2005), with the squared Mahalanobis distance to the segment's mean as cost. The penalty is the one at which chance makes as
many changes as the rate of false alarms says, found from simulated sequences with these covariances. A single recording that is
off while those before and after it agree is an outlier, not two changes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from calib_ros import se3
from calib_ros.arrays import Matrix

FLOOR = 1e-12  # rad^2, m^2; keeps a covariance of zeros invertible
# Differences of an axis from which its own scatter is estimated; of fewer, the median is less certain than the assumption that
# the three axes of rotation, and those of translation, scatter alike.
OWN_SCATTER = 60
MOST_SCATTER = 1e3  # times the usual variance: how much scatter is looked for
FALSE_ALARMS = 0.001  # per recording
# Simulated sequences: enough that a hundred of them exceed the penalty.
EXCEEDING, FEWEST, MOST = 100, 2000, 100_000
BATCH = 2_000_000  # numbers held at a time


@dataclass(frozen=True, eq=False)
class Extrinsics:
    """Estimates of one extrinsic, in the order of time.

    values: (n, 6), rotation vector of R R_0^T and t - t_0 in the camera's axes, rad and m, against a common one of them.
    covariances: (n, 6, 6) of these.
    """

    values: Matrix
    covariances: Matrix

    def __len__(self) -> int:
        return len(self.values)

    def with_scatter(self, variances: Matrix) -> Extrinsics:
        """With the variances (6,) between recordings added to the covariances."""
        return Extrinsics(self.values, self.covariances + np.diag(variances))

    def at(self, positions: NDArray[np.intp]) -> Extrinsics:
        """Some of them."""
        return Extrinsics(self.values[positions], self.covariances[positions])


def extrinsics(transforms: ArrayLike, covariances: ArrayLike) -> Extrinsics:
    """From T_camera_lidar (n, 4, 4) and the covariances (n, 6, 6) of their left twists.

    The common one is that which turns least against all others, so that a few wrong ones do not matter.
    """
    T, C = np.asarray(transforms, float).reshape(-1, 4, 4), np.asarray(covariances, float).reshape(-1, 6, 6)
    if not len(T):
        return Extrinsics(np.zeros((0, 6)), np.zeros((0, 6, 6)))
    R, t = T[:, :3, :3], T[:, :3, 3]
    turns = np.arccos(np.clip((np.einsum("nij,mij->nm", R, R) - 1) / 2, -1, 1))
    common = int(np.argmin(np.median(turns, axis=1)))
    turned = np.array([se3.rotation_vector(own @ R[common].T) for own in R])
    values = np.concatenate([turned, t - t[common]], axis=1)
    A = np.array([se3.parts_jacobian(own) for own in T])
    return Extrinsics(values, A @ C @ np.swapaxes(A, 1, 2) + FLOOR * np.eye(6))


def scatter(sequences: Sequence[Extrinsics]) -> Matrix:
    """Variances (6,), rad^2 and m^2, by which recordings differ beyond their covariances: other scenes, loads, tyres.

    From the differences of successive recordings of each vehicle, which a change of the mount moves once and a wrong recording
    twice: the median of their squares, in units of their variances, is that of chi^2. Zero where the covariances explain them.
    """
    pairs = [own for own in sequences if len(own) > 1]
    if not pairs:
        return np.zeros(6)
    squares = np.concatenate([np.diff(own.values, axis=0) ** 2 for own in pairs])
    diagonals = [np.diagonal(own.covariances, axis1=1, axis2=2) for own in pairs]
    variances = np.concatenate([own[1:] + own[:-1] for own in diagonals])
    alike = [_excess(squares[:, part].ravel(), variances[:, part].ravel()) for part in (slice(0, 3), slice(3, 6))]
    if len(squares) < OWN_SCATTER:
        return np.repeat(alike, 3)
    return np.array([_excess(squares[:, axis], variances[:, axis]) for axis in range(6)])


def _excess(squares: Matrix, variances: Matrix) -> float:
    """Variance per recording, which differences of two have twice, that is missing in `variances` (n,) of differences."""
    wanted = float(chdtri(1, 0.5))

    def median(excess: float) -> float:
        return float(np.median(squares / (variances + 2 * excess)))

    if median(0.0) <= wanted:
        return 0.0
    low, high = 0.0, MOST_SCATTER * float(np.median(squares))
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if median(middle) > wanted else (low, middle)
    return high


@dataclass(frozen=True, eq=False)
class Segments:
    """What a sequence comes to.

    labels: (n,) number of each recording's segment, also of an outlier, which lies within it. outliers: positions. means: (k, 6)
    and covariances: (k, 6, 6) of the segments. changes: positions of the last recording before each and the first after it,
    outliers left out.
    """

    labels: NDArray[np.intp]
    outliers: tuple[int, ...]
    means: Matrix
    covariances: Matrix
    changes: tuple[tuple[int, int], ...]


def segments(sequence: Extrinsics, false_alarms: float = FALSE_ALARMS, seed: int = 0) -> Segments:
    """Divide a sequence into segments of constant extrinsic.

    sequence: in the order of time, with the scatter between recordings in its covariances. false_alarms: expected number of
    changes found per recording where there is none, in (0, 0.5). seed: of the simulation that finds the penalty.
    """
    n = len(sequence)
    if not n:
        return Segments(np.zeros(0, np.intp), (), np.zeros((0, 6)), np.zeros((0, 6, 6)), ())
    penalty = change_penalty(sequence.covariances, false_alarms, seed)
    outlier_penalty = float(chdtri(6, false_alarms))
    outliers: list[int] = []
    while True:
        kept = np.setdiff1d(np.arange(n), outliers)
        sums = _Sums(sequence.at(kept))
        starts = _best_starts(sums, penalty)
        wrong = _outlier(sums, starts, penalty, outlier_penalty)
        if wrong is None or len(kept) <= 3:
            break
        outliers.append(int(kept[wrong]))
    ends = [*starts[1:], len(kept)]
    # An outlier between two segments belongs to the earlier one.
    labels = np.searchsorted(kept[starts], np.arange(n), side="right") - 1
    fits = [sums.mean(start, end) for start, end in zip(starts, ends, strict=True)]
    means, covariances = (np.array(own) for own in zip(*fits, strict=True))
    changes = tuple((int(kept[own - 1]), int(kept[own])) for own in starts[1:])
    return Segments(np.maximum(labels, 0), tuple(sorted(outliers)), means, covariances, changes)


class _Sums:
    """Cumulative sums of a sequence, from which the cost of any segment [i, j) follows: of inverse covariances, W (n + 1, 6, 6),
    and of the values weighted by them, v (n + 1, 6)."""

    def __init__(self, sequence: Extrinsics) -> None:
        W = np.linalg.inv(sequence.covariances)
        v = np.einsum("nij,nj->ni", W, sequence.values)
        self.n = len(sequence)
        self.W, self.v, self._square = (
            np.concatenate([np.zeros((1, *own.shape[1:])), np.cumsum(own, axis=0)])
            for own in (W, v, np.einsum("ni,ni->n", v, sequence.values))
        )

    def cost(self, starts: NDArray[np.intp], end: int) -> Matrix:
        """Sum of squared distances to their mean of the segments [start, end) that begin at `starts` (m,)."""
        v = self.v[end] - self.v[starts]
        mean = np.linalg.solve(self.W[end] - self.W[starts], v[..., None])[..., 0]
        return np.asarray(np.maximum(self._square[end] - self._square[starts] - np.einsum("ni,ni->n", v, mean), 0.0))

    def mean(self, start: int, end: int) -> tuple[Matrix, Matrix]:
        """Mean (6,) of a segment and its covariance (6, 6)."""
        C = np.linalg.inv(self.W[end] - self.W[start])
        return C @ (self.v[end] - self.v[start]), C

    def distance(self, k: int, start: int, end: int) -> float:
        """Squared distance of element k to the mean of the others in its segment."""
        whole = self.cost(np.array([start]), end)[0]
        W, v = (own[end] - own[start] - own[k + 1] + own[k] for own in (self.W, self.v))
        square = self._square[end] - self._square[start] - self._square[k + 1] + self._square[k]
        return float(whole - (square - v @ np.linalg.solve(W, v)))


def _best_starts(sums: _Sums, penalty: float) -> list[int]:
    """Starts of the segments with the least sum of costs and penalties."""
    previous, out = _best_partitions(sums.W, sums.v[:, None], penalty)[0], [sums.n]
    while out[0] > 0:
        out.insert(0, int(previous[out[0], 0]))
    return out[:-1]


def _outlier(sums: _Sums, starts: list[int], penalty: float, outlier_penalty: float) -> int | None:
    """The element that is off while its neighbours agree, and most so; None if there is none."""
    ends = [*starts[1:], sums.n]
    found: dict[int, float] = {}
    for s, (start, end) in enumerate(zip(starts, ends, strict=True)):
        if end - start == 1 and 0 < s < len(starts) - 1:
            first, (a, A), (b, B) = starts[s - 1], sums.mean(starts[s - 1], start), sums.mean(end, ends[s + 1])
            if float((a - b) @ np.linalg.solve(A + B, a - b)) < penalty:
                whole, alone = sums.cost(np.array([first, start]), end)
                found[start] = penalty + float(whole - alone - sums.cost(np.array([first]), start)[0])
        if end - start > 2:
            inner = {k: sums.distance(k, start, end) for k in range(start + 1, end - 1)}
            found |= {k: square for k, square in inner.items() if square > outlier_penalty}
    return max(found, key=lambda k: found[k], default=None)


def change_penalty(covariances: Matrix, false_alarms: float, seed: int = 0) -> float:
    """Gain per change at which a sequence without change has as many as the rate of false alarms says.

    covariances: (n, 6, 6). The gains of neighbouring divisions are correlated, more so in long segments and where few recordings
    have all the weight, so that no closed form holds: sequences are simulated. Where one alarm comes, others often come with it:
    the share of sequences with any is lower by as much.
    """
    n = len(covariances)
    if n < 2:
        return float(chdtri(6, false_alarms))
    probability = -np.expm1(-false_alarms * n)
    count = int(np.clip(EXCEEDING / probability, FEWEST, MOST))
    *_, total = summed = np.cumsum(np.linalg.inv(covariances), axis=0)
    before = summed[:-1]
    share = before @ np.linalg.inv(total)
    G = np.linalg.inv(before) + np.linalg.inv(total - before)
    half = np.linalg.cholesky((G + np.swapaxes(G, 1, 2)) / 2)
    gains = []  # of the best division of each sequence
    for sums in _simulated(covariances, count, seed):
        off = (sums[:-1] - sums[-1] @ np.swapaxes(share, 1, 2)) @ half
        gains.append(np.einsum("nsi,nsi->ns", off, off).max(axis=0))
    largest = np.concatenate(gains)
    penalty = float(np.quantile(largest, 1 - probability))
    chosen, first, alarming = np.flatnonzero(largest > penalty)[:EXCEEDING], 0, []
    for sums in _simulated(covariances, count, seed):
        own = chosen - first
        alarming.append(sums[:, own[(own >= 0) & (own < sums.shape[1])]])
        first += sums.shape[1]
    W, v = (np.concatenate([np.zeros((1, *own.shape[1:])), own]) for own in (summed, np.concatenate(alarming, axis=1)))
    per_alarm = float(_best_partitions(W, v, penalty)[1].mean())
    return float(np.quantile(largest, 1 - min(probability, false_alarms * n / per_alarm)))


def _simulated(covariances: Matrix, count: int, seed: int) -> Iterator[Matrix]:
    """Cumulative sums (n, m, 6) of the weighted values of so many sequences without change, some at a time."""
    n, rng = len(covariances), np.random.default_rng(seed)
    roots = np.linalg.cholesky(np.linalg.inv(covariances))
    batch = max(BATCH // (6 * n), 1)
    for first in range(0, count, batch):
        noise = rng.standard_normal((n, min(batch, count - first), 6))
        yield np.cumsum(noise @ np.swapaxes(roots, 1, 2), axis=0)


def _best_partitions(W: Matrix, v: Matrix, penalty: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For sequences with the same covariances, the start (n + 1, m) of the last segment of the best partition up to each end, and
    the number of changes (m,) in that of the whole. W: (n + 1, 6, 6) and v: (n + 1, m, 6), see `_Sums`."""
    n, m = len(v) - 1, v.shape[1]
    best, (starts, changes) = np.zeros((n + 1, m)), np.zeros((2, n + 1, m), np.intp)
    best[0], changes[0] = -penalty, -1
    for end in range(1, n + 1):
        inverse = np.linalg.inv(W[end] - W[:end])
        own = v[end] - v[:end]
        # The squares of the values are the same in every partition, and left out.
        total = best[:end] + penalty - np.einsum("smi,sij,smj->sm", own, inverse, own, optimize=True)
        starts[end] = np.argmin(total, axis=0)
        best[end], changes[end] = total[starts[end], np.arange(m)], changes[starts[end], np.arange(m)] + 1
    return starts, changes[n]

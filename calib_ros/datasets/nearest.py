"""Nearest neighbours in time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]


def nearest_index(stamps: Stamps, wanted: Stamps) -> NDArray[np.intp]:
    """For each of wanted (m,) the index into stamps (n >= 1, sorted) that lies nearest.

    Of two equally near, the earlier.
    """
    after = np.searchsorted(stamps, wanted)
    right = np.minimum(after, len(stamps) - 1)
    left = np.maximum(after - 1, 0)
    return np.where(np.abs(wanted - stamps[left]) <= np.abs(stamps[right] - wanted), left, right)


def nearest_pairs(a: Stamps, b: Stamps, tolerance: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of two sorted arrays of stamps at most `tolerance` apart, nearest first, each stamp used once.

    Same unit throughout. Returns the indices (k,) into a and into b, in the order of a. Stamps that are
    each other's nearest are paired, then the same among those left over: what a greedy choice by distance
    would give, without its loop over pairs.
    """
    left_a, left_b = np.arange(len(a)), np.arange(len(b))
    pairs: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = []
    while len(left_a) and len(left_b):
        to_b = nearest_index(b[left_b], a[left_a])
        to_a = nearest_index(a[left_a], b[left_b])
        here = np.arange(len(left_a))
        mutual = (to_a[to_b] == here) & (np.abs(a[left_a] - b[left_b][to_b]) <= tolerance)
        if not mutual.any():
            break
        pairs.append((left_a[mutual], left_b[to_b[mutual]]))
        left_a, left_b = left_a[~mutual], np.delete(left_b, to_b[mutual])
    if not pairs:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    ia, ib = (np.concatenate(part) for part in zip(*pairs, strict=True))
    order = np.argsort(ia)
    return ia[order], ib[order]

"""Scores over the six axes around an extrinsic (thesis figures 4.7, 4.10, 4.13)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.registration.score.point_score import Score

Matrix = NDArray[np.float64]
FLAT = 1e-9  # of a score's size; less is rounding
AXES = ("r_x", "r_y", "r_z", "t_x", "t_y", "t_z")


@dataclass(frozen=True, eq=False)
class Curves:
    """offsets: (6, n) along each axis, deg for rotations and cm for translations. values: (6, n) scores there."""

    offsets: Matrix
    values: Matrix

    @property
    def peaks(self) -> Matrix:
        """Where each curve is highest (6,), deg and cm: by a parabola through the highest sample and its neighbours; NaN for one
        that is flat."""
        out = np.full(6, np.nan)
        for axis, (x, y) in enumerate(zip(self.offsets, self.values, strict=True)):
            if np.ptp(y) <= FLAT * max(float(np.abs(y).max()), 1.0):
                continue
            k = int(np.argmax(y))
            out[axis] = x[k]
            if 0 < k < len(x) - 1:
                before, here, after = y[k - 1 : k + 2]
                bend = before - 2 * here + after
                if bend < 0:
                    out[axis] += 0.5 * (before - after) / bend * (x[1] - x[0])
        return out

    def scaled(self) -> Matrix:
        """Values (6, n) with every curve from 0 to 1, to compare scores of different units."""
        low, high = self.values.min(axis=1, keepdims=True), self.values.max(axis=1, keepdims=True)
        return np.asarray((self.values - low) / np.maximum(high - low, 1e-12))


def curves(score: Score, T: Matrix, rotation_deg: float = 2.0, translation_m: float = 0.3, samples: int = 41) -> Curves:
    """Score along each axis of a left twist at T (4, 4), the others at rest, `samples` values over +- the half widths."""
    unit = np.linspace(-1, 1, samples)
    half = np.repeat([np.deg2rad(rotation_deg), translation_m], 3)
    values = [[score.value(se3.exp(x * h * axis) @ T) for x in unit] for h, axis in zip(half, np.eye(6), strict=True)]
    return Curves(np.repeat([rotation_deg, 100 * translation_m], 3)[:, None] * unit, np.array(values))

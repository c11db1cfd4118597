"""A scan as the range image that networks take (Milioto et al. 2019, RangeNet++), and its classes back to the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import UNLABELLED
from calib_ros.semantics.labels import Classes

# A point this near in range to the one that its pixel shows has that one's class, and farther ones have no vote. In m, the
# cut-off of RangeNet++'s search for neighbours; as a share of the range, since far ground is seen at grazing angles. With true
# labels in the pixels 98.5 to 99.7 % of the points get theirs back (a KITTI scan, three synthetic ones, 512 to 2048 columns),
# with the cut-off alone 97.4 to 99.4 %.
NEAR, NEAR_SHARE = 1.0, 0.1
REACH = 2  # pixels to each side that are asked about a hidden point, as there: 5x5
# deg; points this far above or below the field of view go to the border rows, as those who trained the networks had it: KITTI's
# scans reach 2.4 deg above. What lies farther outside no network has seen.
BEYOND = 3.0
SHARES = 10  # SemanticClasses that may get votes


@dataclass(frozen=True, eq=False)
class RangeView:
    """Range image of n points. index: (H, W) int32, the nearest point of each pixel, -1 where there is none.

    row, column: (n,) pixel of each point. inside: (n,) whether the image covers its direction. range: (n,) float32, m.
    """

    index: NDArray[np.int32]
    row: NDArray[np.intp]
    column: NDArray[np.intp]
    inside: NDArray[np.bool_]
    range: NDArray[np.float32]
    whole_turn: bool

    @property
    def ranges(self) -> NDArray[np.float32]:
        """Range of each pixel (H, W), NaN where it is empty."""
        values = np.append(self.range, np.float32(np.nan))
        return np.asarray(values[self.index], np.float32)


def range_view(
    xyz: NDArray[np.float32], size: tuple[int, int], fov_deg: tuple[float, float], azimuth_deg: float = 360.0
) -> RangeView:
    """Points (n, 3) m, finite and not at the origin, in an image of this (height, width).

    fov_deg: highest and lowest elevation. azimuth_deg: angle that the columns cover, straight ahead (+x) in the middle.
    """
    height, width = size
    x, y, z = xyz.astype(np.float64).T
    distance = np.sqrt(x * x + y * y + z * z)
    highest, lowest = np.deg2rad(fov_deg)
    turn = -np.arctan2(y, x) / np.deg2rad(azimuth_deg) + 0.5
    inside = (turn >= 0) & (turn <= 1)
    column = np.clip(np.floor(turn * width), 0, width - 1).astype(np.intp)
    elevation, margin = np.arcsin(z / distance), np.deg2rad(BEYOND)
    inside &= (elevation <= highest + margin) & (elevation >= lowest - margin)
    down = 1 - (elevation - lowest) / (highest - lowest)
    row = np.clip(np.floor(down * height), 0, height - 1).astype(np.intp)
    index = np.full(size, -1, np.int32)
    order = np.argsort(-distance, kind="stable")  # later writes win: nearest last
    order = order[inside[order]]
    index[row[order], column[order]] = order
    return RangeView(index, row, column, inside, distance.astype(np.float32), azimuth_deg == 360.0)


def classes_of_points(view: RangeView, classes: Classes) -> Classes:
    """SemanticClass (n,) of the points from those of the pixels (H, W).

    A pixel shows its nearest point. Points far behind that have the class that most of the surroundings at their own range have,
    nearer in range with more weight; UNLABELLED where there are none.
    """
    out = classes[view.row, view.column]
    ranges, near = view.ranges, np.maximum(np.float32(NEAR), np.float32(NEAR_SHARE) * view.range)
    with np.errstate(invalid="ignore"):
        hidden = np.flatnonzero(view.inside & ~(np.abs(ranges[view.row, view.column] - view.range) < near))
    out[hidden] = _vote(view, classes, ranges, hidden, near[hidden])
    out[~view.inside] = UNLABELLED
    return out


def _vote(
    view: RangeView, classes: Classes, ranges: NDArray[np.float32], points: NDArray[np.intp], near: NDArray[np.float32]
) -> Classes:
    """Classes of some points by their surroundings."""
    votes = np.zeros((len(points), SHARES), np.float32)
    height, width = classes.shape
    each = np.arange(len(points))
    for down in range(-REACH, REACH + 1):
        row = view.row[points] + down
        for right in range(-REACH, REACH + 1):
            column = view.column[points] + right
            there = (row >= 0) & (row < height)
            if not view.whole_turn:
                there &= (column >= 0) & (column < width)
            at = np.clip(row, 0, height - 1), column % width
            weight = np.nan_to_num(1 - np.abs(ranges[at] - view.range[points]) / near, nan=0.0)
            there &= (weight > 0) & (classes[at] < SHARES)
            votes[each[there], classes[at][there]] += weight[there]
    winner = votes.argmax(axis=1).astype(np.uint8)
    return np.asarray(np.where(votes.max(axis=1, initial=0) > 0, winner, UNLABELLED), np.uint8)

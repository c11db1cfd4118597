"""What a cluster of points is by its measures: a vehicle, a cyclist, a person, or nothing that can be told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import UNLABELLED, SemanticClass
from calib_ros.semantics.cluster_shapes import Surfaces, box

Floats = NDArray[np.float32]
HEAD = 0.25  # m; the uppermost part, which tells cars, people and riders from boxes, walls and hedges
STANDS = 0.6  # m above the ground at most where a thing's lowest point is seen: a bumper
CUT = 0.01  # share of points at the edge of the field of view: the top is not seen, so that it may be anything
# Head of a vehicle as a share of its length; what is as long at its top is a wall or a hedge, unless it is as deep as a van.
NARROWER = 0.85
WIDEST, LONGEST = 2.4, 5.8  # m; with mirrors, and of a van
CAR_TOP, VAN_TOP = 1.9, 2.3  # m
ROOF, BONNET = 1.15, 0.95  # m; lowest top of a vehicle, and of one whose roof lies between two rings
SIDE, END, DEEP = (3.0, 5.3), 1.4, 1.2  # m; lengths of a side, width of an end, and depth that shows more than one of them
THIN_SIDE, THIN_END = 0.4, 0.3  # m; depth of the least that is seen of a side or an end: both are curved, and walls are not
CABIN = 0.5  # m; length of a vehicle's head at least. Riders' and bushes' are smaller
# Scatter as of Surfaces: cars 0.02 to 0.06 near, more where rings are farther apart than cars are curved; bushes 0.1.
SMOOTH, SMOOTH_PER_M, SMOOTH_FAR = 0.06, 0.001, 0.09
LYING = 0.9  # `level` of the slope of a bank; cars seen from above come to 0.8
RIDER = (1.1, 2.1), (0.25, 1.0), (1.55, 2.1)  # m; length, width and height of a two-wheeler with its rider
RIDER_SCATTER, RIDER_LEVEL, RIDER_LOW, RIDER_HEAD = 0.13, 0.35, 0.35, 0.4  # the last is a share of the length; 0.35 m: wheels
PERSON = (0.4, 0.95), (0.2, 0.75), (1.35, 2.05)  # m; from a child beside the road to a stride, its depth, and heights
PERSON_HEAD, PERSON_SLIM = 0.4, 1.7  # m, and times as high as long: bushes and bins are stouter
FARTHEST = 40.0  # m; people beyond are a few points that trunks and posts could be


@dataclass(frozen=True)
class Thing:
    """A cluster's length, width, bottom, top and distance (m), length of its HEAD (m), scatter and level (median, as of
    Surfaces), and whether the field of view cuts its top off."""

    length: float
    width: float
    bottom: float
    top: float
    distance: float
    head: float
    scatter: float
    level: float
    cut: bool

    @property
    def kind(self) -> int:
        """VEHICLE, CYCLIST, PERSON or UNLABELLED."""
        if self.cut or self.bottom > STANDS:
            return UNLABELLED
        if self._is_vehicle():
            return SemanticClass.VEHICLE
        if self.distance > FARTHEST:
            return UNLABELLED
        if self._is_rider():
            return SemanticClass.CYCLIST
        return SemanticClass.PERSON if self._is_person() else UNLABELLED

    def _is_vehicle(self) -> bool:
        whole = self.width >= DEEP
        boxy = self.head > NARROWER * self.length and not (whole and self.length >= SIDE[0])
        if boxy or self.level > LYING or not END <= self.length <= LONGEST or self.width > WIDEST:
            return False
        if whole and self.top <= CAR_TOP and self.scatter < min(SMOOTH + SMOOTH_PER_M * self.distance, SMOOTH_FAR):
            return self.top >= (BONNET if self.length >= SIDE[0] else ROOF)
        if self.scatter >= SMOOTH or not ROOF <= self.top <= (VAN_TOP if whole else CAR_TOP) or self.head < CABIN:
            return False
        if self.length >= SIDE[0]:
            return whole or (self.length <= SIDE[1] and self.width >= THIN_SIDE)
        return self.width >= THIN_END

    def _is_rider(self) -> bool:
        shape = self.scatter < RIDER_SCATTER and self.level < RIDER_LEVEL and self.bottom < RIDER_LOW
        return shape and self._measures(RIDER) and self.head <= RIDER_HEAD * self.length

    def _is_person(self) -> bool:
        return self._measures(PERSON) and self.top > PERSON_SLIM * self.length and self.head < PERSON_HEAD

    def _measures(self, limits: tuple[tuple[float, float], ...]) -> bool:
        return all(low <= m <= high for m, (low, high) in zip((self.length, self.width, self.top), limits, strict=True))


def measure(xyz: Floats, shape: Surfaces, cut: NDArray[np.bool_]) -> Thing:
    """The Thing that points (n, 3) are, z = height above the ground (m), with their shape and whether they are cut off (n,)."""
    length, width = box(xyz[:, :2])
    bottom, top = float(xyz[:, 2].min()), float(xyz[:, 2].max())
    known = shape.scatter[np.isfinite(shape.scatter)]
    scatter = float(np.median(known)) if len(known) else np.inf
    head = box(xyz[xyz[:, 2] > top - HEAD, :2])[0]
    distance = float(np.hypot(*xyz[:, :2].mean(axis=0)))
    cut_off = np.count_nonzero(cut) > CUT * len(cut)
    return Thing(length, width, bottom, top, distance, head, scatter, float(np.median(shape.level)), bool(cut_off))

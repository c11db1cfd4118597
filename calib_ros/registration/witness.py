"""Classes as a second witness: do labelled points meet pixels of their class at the optimum that the edges have chosen?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.first_guess.class_score import judged, spread
from calib_ros.registration.first_guess.class_view import ClassView
from calib_ros.registration.plausibility import around
from calib_ros.registration.point_score import PointScore

Matrix = NDArray[np.float64]
# Share of the extrinsics around that meet the classes better, and standard deviations above their mean. With the network of the
# package, on single KITTI frames of two drives: of 43 right optima 34 agree and 3 disagree, whose edges leave no doubt; of 74
# wrong ones, in boxes beside the truth and in pictures of other places, 11 agree, 7 of them within 3.5 deg, and 39 disagree
# (searched with borders of classes blended in by 0.2).
AGREES, STANDS_OUT = 0.02, 1.5
DISAGREES = 0.15
# Of the distinctness of the edges that is needed. Of these optima the edges alone accept 41 right and 8 wrong ones, with the
# classes 43 and 9.
WITH_AGREEMENT, WITH_DISAGREEMENT = 0.8, 1.2


def class_witness(views: Sequence[ClassView]) -> PointScore | None:
    """The score of the classes of frames; None where they show too little in common."""
    try:
        return judged(spread(views)) if views else None
    except TooFewFeaturesError:
        return None


def in_doubt(distinctness: float) -> bool:
    """Whether the classes can change the verdict. distinctness: as a share of what is needed without them."""
    return WITH_AGREEMENT <= distinctness < WITH_DISAGREEMENT


def needed_with(witness: PointScore | None, T: Matrix) -> float:
    """The factor on the distinctness that T_camera_lidar (4, 4) needs, by what the classes say of it; 1.0 without a witness."""
    if witness is None:
        return 1.0
    level = witness.n_levels - 1
    here, others = witness.at(level).value(T), witness.values(around(T), level)
    beaten_by = float((others > here).mean())
    if beaten_by <= AGREES and here - others.mean() >= STANDS_OUT * others.std():
        return WITH_AGREEMENT
    return WITH_DISAGREEMENT if beaten_by > DISAGREES else 1.0


def objection(factor: float) -> str:
    """What a refusal says of a factor on the distinctness needed; empty where classes do not speak against the optimum."""
    return "few labelled points meet pixels of their class there" if factor > 1 else ""

"""What networks take a class for: pixels of a cyclist are those of a vehicle or a person sooner than of the sky."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.classes import SemanticClass as C

# Share of the pixels of a class, in percent, that networks give to another: half of what the package's own network does with
# the validated places of CamVid, of which the frames that the guess is measured on are none; larger networks confuse less.
# With it one of the guesses is near the truth for 15 of 20 single KITTI frames, without for 13, with all of it for 15.
_TAKEN_FOR = {
    C.OTHER: {C.VEHICLE: 2, C.PERSON: 2, C.POLE: 2, C.BUILDING: 2, C.VEGETATION: 19},
    C.VEHICLE: {C.PERSON: 1, C.BUILDING: 3, C.VEGETATION: 1, C.GROUND: 1},
    C.PERSON: {C.OTHER: 2, C.VEHICLE: 3, C.CYCLIST: 3, C.POLE: 2, C.BUILDING: 4, C.VEGETATION: 1, C.GROUND: 2},
    C.CYCLIST: {C.OTHER: 1, C.VEHICLE: 20, C.PERSON: 14, C.BUILDING: 1, C.VEGETATION: 3, C.GROUND: 2},
    C.POLE: {C.OTHER: 2, C.VEHICLE: 1, C.PERSON: 2, C.SIGN: 1, C.BUILDING: 10, C.VEGETATION: 8, C.GROUND: 2, C.SKY: 1},
    C.SIGN: {C.OTHER: 3, C.VEHICLE: 1, C.PERSON: 1, C.POLE: 7, C.BUILDING: 22, C.VEGETATION: 11},
    C.BUILDING: {C.OTHER: 4, C.VEHICLE: 1, C.PERSON: 1, C.POLE: 1, C.SIGN: 1, C.VEGETATION: 2, C.GROUND: 1, C.SKY: 1},
    C.VEGETATION: {C.SIGN: 1, C.BUILDING: 1, C.SKY: 1},
    C.SKY: {C.VEGETATION: 4},
}


def taken_for() -> NDArray[np.float64]:
    """Share (10, 10) of the pixels of a class (row) that are labelled as another (column)."""
    shares = np.zeros((len(C), len(C)))
    for own, others in _TAKEN_FOR.items():
        for other, percent in others.items():
            shares[own, other] = percent / 100
    np.fill_diagonal(shares, 1 - shares.sum(axis=1))
    return shares

"""Maps of classes that cannot be right, and those that can."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros.frame import UNLABELLED
from calib_ros.frame import SemanticClass as C
from calib_ros_semantics.models.segmentation import implausible, of_little_use
from calib_ros_synthetic.drive import SyntheticDrive

ALL = frozenset(int(c) for c in C)
THINGS = {C.VEHICLE, C.PERSON, C.CYCLIST}


def classes(**percent: int) -> np.ndarray:
    """A map with these shares; the rest is unlabelled."""
    out = np.full(100, UNLABELLED, np.uint8)
    at = 0
    for name, share in percent.items():
        out[at : at + share] = C[name.upper()]
        at += share
    return out.reshape(10, 10)


@pytest.mark.parametrize(
    ("shares", "said"),
    [
        ({"sign": 70, "ground": 20, "sky": 10}, "70 % are sign"),
        ({"sign": 29, "vegetation": 26, "vehicle": 16, "ground": 29}, "29 % are sign"),
        ({"ground": 100}, "100 % are ground"),
        ({"sky": 60, "building": 40}, "no ground (0.0 %), sky the most"),
        ({"person": 30, "ground": 20}, "60 % are person"),
        ({"person": 45, "pole": 30, "ground": 25}, "30 % are pole"),
        ({"ground": 30, "building": 40, "sky": 20, "vehicle": 10}, ""),
        ({"vehicle": 88, "ground": 12}, ""),  # behind a lorry
        ({"vegetation": 90, "ground": 10}, ""),
        ({"person": 45, "building": 35, "ground": 20}, ""),  # a crowd
        ({"ground": 5, "building": 90}, ""),
        ({}, ""),
    ],
)
def test_what_cannot_be_right_is_told_with_its_share(shares: dict[str, int], said: str) -> None:
    found = implausible(classes(**shares), ALL)
    assert said in found
    assert bool(found) == bool(said)


@pytest.mark.parametrize(
    ("shares", "known", "right"),
    [
        ({"vehicle": 60, "person": 30, "cyclist": 10}, THINGS, True),
        ({"vehicle": 100}, {C.VEHICLE, C.OTHER}, True),
        ({"vehicle": 34}, THINGS, True),  # all that has a class in a scan may well be cars
        ({"person": 8}, THINGS, True),
        ({"person": 60}, THINGS, False),
    ],
)
def test_a_class_that_a_network_does_not_know_cannot_be_missed(shares: dict[str, int], known: set, right: bool) -> None:
    assert (implausible(classes(**shares), known) == "") == right


def test_synthetic_drives_are_plausible(drive: SyntheticDrive) -> None:
    frame = drive[0]
    assert implausible(frame.classes, ALL) == implausible(frame.cloud.label, ALL) == ""


def test_classes_of_little_use_are_told() -> None:
    assert "97 % have a class that is of no use" in of_little_use(classes(other=40, ground=3))
    assert of_little_use(classes(ground=20)) == ""
    assert of_little_use(np.zeros((0, 0), np.uint8)) == ""

"""Can a map of classes be right? A network that is fed wrongly answers all the same, and nothing else tells.

Limits follow from what the classes are. A vehicle stands on the ground, and its sensors see some; people, cyclists, poles and
signs are thin; no street is of one class. In 47 pictures of nine rigs (KITTI, nuScenes, Waymo and others) two networks trained on
other data find at least 11 % of ground, at most 8 % of one of the thin classes and at most 79 % of any class: each limit is
several times away from that. A crowd before the bumper may be half of a picture, poles and signs may not.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import UNLABELLED, SemanticClass
from calib_ros_semantics.models.labels import Classes

# Shares of what has a class; of all pixels or points, where a network does not know what things stand on and before.
MIN_GROUND, MAX_ONE = 0.01, 0.95
MAX_THIN = {SemanticClass.PERSON: 0.5, SemanticClass.CYCLIST: 0.5, SemanticClass.POLE: 0.25, SemanticClass.SIGN: 0.25}
MIN_USEFUL = 0.05  # share below which classes are of little use
BEHIND_THINGS = frozenset({SemanticClass.GROUND, SemanticClass.BUILDING, SemanticClass.VEGETATION, SemanticClass.SKY})
ADVICE = "check what its inputs are scaled by (mean, std, scale, channels) and its labels, in a YAML beside it"


def implausible(classes: Classes, known: Collection[int]) -> str:
    """Why a network's SemanticClass of pixels or points (any shape) cannot be right; empty if they can.

    known: classes that the network tells apart; one that it does not know cannot be missed. Where it knows vehicles and people
    only, all that has a class may well be a vehicle.
    """
    share = _shares(classes, of_all=BEHIND_THINGS.isdisjoint(known))
    if not share.any():
        return ""
    most = int(share.argmax())
    name = _name(most)
    if share[most] > MAX_ONE and len(known) > 2:
        return f"its classes are implausible: {100 * share[most]:.0f} % are {name}; {ADVICE}"
    thin = max(MAX_THIN, key=lambda own: share[own] / MAX_THIN[own])
    if share[thin] > MAX_THIN[thin]:
        return f"its classes are implausible: {100 * share[thin]:.0f} % are {_name(thin)}; {ADVICE}"
    if SemanticClass.GROUND in known and share[SemanticClass.GROUND] < MIN_GROUND:
        return f"its classes are implausible: no ground ({100 * share[SemanticClass.GROUND]:.1f} %), {name} the most; {ADVICE}"
    return ""


def of_little_use(classes: Classes) -> str:
    """Why classes of pixels or points (any shape) hardly help a calibration; empty if they do."""
    count = np.bincount(classes.ravel(), minlength=256)
    nothing = count[UNLABELLED] + count[SemanticClass.OTHER]
    if not classes.size or 1 - nothing / classes.size >= MIN_USEFUL:
        return ""
    return (
        f"{100 * nothing / classes.size:.0f} % have a class that is of no use here; give 'labels:' in a YAML beside the model, "
        "or take one for streets"
    )


def _shares(classes: Classes, of_all: bool) -> NDArray[np.float64]:
    """Share (256,) of each class among what has one, or of all."""
    count = np.bincount(classes.ravel(), minlength=256).astype(float)
    whole = classes.size if of_all else count.sum() - count[UNLABELLED]
    count[UNLABELLED] = 0.0
    return np.asarray(count / max(whole, 1.0))


def _name(number: int) -> str:
    return SemanticClass(number).name.lower()

"""The semantic classes that camera and LiDAR have in common."""

from __future__ import annotations

from enum import IntEnum


class SemanticClass(IntEnum):
    """Class of a point or a pixel."""

    OTHER = 0  # something known to be none of the others
    VEHICLE = 1
    PERSON = 2
    CYCLIST = 3  # two-wheelers and those who ride them
    POLE = 4
    SIGN = 5  # traffic signs and lights
    BUILDING = 6
    VEGETATION = 7
    GROUND = 8
    SKY = 9


UNLABELLED = 255  # nobody knows; in arrays of classes (uint8)
# What eq. 3.16 counts as important: vehicle, pedestrian, cyclist, pole, traffic sign and light.
MAIN_CLASSES = (SemanticClass.VEHICLE, SemanticClass.PERSON, SemanticClass.CYCLIST, SemanticClass.POLE, SemanticClass.SIGN)

"""What can make an edge of a scan."""

from __future__ import annotations

from enum import IntEnum


class EdgeKind(IntEnum):
    """What makes an edge, and with it the direction of the image gradient that it must meet."""

    SIDE = 0  # the range jumps to the left or right
    TOP = 1  # the range jumps above
    REFLECTIVITY = 2  # the reflectivity changes along the ring, the range does not
    SKY_SIDE = 3  # nothing returns to the left or right
    SKY_TOP = 4  # nothing returns above


UPWARD = (EdgeKind.TOP, EdgeKind.SKY_TOP)

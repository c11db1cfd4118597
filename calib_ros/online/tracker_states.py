"""How far the current extrinsic is to be relied on: the tracker's states, and what leads from one to another.

docs/online.md shows the table. A suspicion of the monitor and a blind sensor are no states: they come and go over any of these,
and what was known before holds again afterwards.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple


class TrackerState(Enum):
    """What the current extrinsic rests on."""

    INITIAL = "no estimate yet"
    TENTATIVE = "one estimate, to be confirmed"
    CONFIRMED = "estimates and keyframes agree"
    LOST = "it has moved"


class Confirmations(NamedTuple):
    """What confirms an extrinsic. keyframes: consistent ones. estimates: that agree. clocks: 1 = frames that show the offset."""

    keyframes: int = 0
    estimates: int = 0
    clocks: int = 0


NOTHING = Confirmations()


class TrackerEvent(Enum):
    """What changes the state."""

    AGREES_WITH_SAVED = "the first estimate agrees with the saved extrinsic"
    ESTIMATE_ELSEWHERE = "an estimate that nothing confirms yet is accepted"
    ESTIMATE_CONFIRMED = "keyframes, another estimate and the clocks confirm it"
    OTHER_CLOCKS = "an estimate rests on another time offset"
    MOVED = "the monitor or a new search says that it has moved"
    FOUND_AGAIN = "estimates in a row agree, or one was asked for"


S, E = TrackerState, TrackerEvent

# A pair that is not listed cannot happen, and raises a KeyError. Going back to the initial extrinsic makes a new tracker.
TRANSITIONS: dict[tuple[TrackerState, TrackerEvent], TrackerState] = {
    (S.INITIAL, E.AGREES_WITH_SAVED): S.CONFIRMED,
    (S.INITIAL, E.ESTIMATE_ELSEWHERE): S.TENTATIVE,
    (S.INITIAL, E.MOVED): S.LOST,
    (S.INITIAL, E.OTHER_CLOCKS): S.INITIAL,
    (S.TENTATIVE, E.ESTIMATE_CONFIRMED): S.CONFIRMED,
    (S.TENTATIVE, E.ESTIMATE_ELSEWHERE): S.TENTATIVE,
    (S.TENTATIVE, E.OTHER_CLOCKS): S.INITIAL,
    (S.TENTATIVE, E.MOVED): S.LOST,
    (S.CONFIRMED, E.ESTIMATE_ELSEWHERE): S.TENTATIVE,
    (S.CONFIRMED, E.OTHER_CLOCKS): S.INITIAL,
    (S.CONFIRMED, E.MOVED): S.LOST,
    (S.LOST, E.MOVED): S.LOST,  # the monitor, of what an estimate has found meanwhile
    (S.LOST, E.FOUND_AGAIN): S.TENTATIVE,
    (S.LOST, E.OTHER_CLOCKS): S.INITIAL,
}

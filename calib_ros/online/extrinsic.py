"""What the node tells the world."""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib_ros.result import Result


@dataclass(frozen=True, eq=False)
class Extrinsic:
    """What the node tells the world: the extrinsic in force, and how the newest estimate compares with it.

    result.status is the newest estimate's status, or what the monitor says against the extrinsic in force: suspect, moved,
    blinded. drift: see monitor.drift. accepted: estimates taken in so far. verdict: what the monitor says of the newest
    keyframes, in words; "" before the first. p_value: how probable it is that keyframes of a right extrinsic look as wrong as
    they do; NaN if unknown.
    """

    result: Result
    drift: float = 0.0
    accepted: int = 0
    verdict: str = ""
    p_value: float = math.nan

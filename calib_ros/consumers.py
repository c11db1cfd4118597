"""Consumers of the extrinsic, and whether an extrinsic is known well enough for each of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from calib_ros.arrays import Covariance
from calib_ros.errors import ConfigError

SIGMAS = 2.0  # an error is within so many standard deviations with 95 %


@dataclass(frozen=True)
class Consumer:
    """deg, m: the largest errors of rotation and translation that it can live with."""

    name: str
    deg: float
    m: float

    def is_served(self, covariance: Covariance | None) -> bool:
        """Whether the tolerances hold along every direction, by a covariance (6, 6) of a left perturbation, rad and m; None =
        unknown: it is not."""
        if covariance is None:
            return False
        turn, shift = (SIGMAS * math.sqrt(np.linalg.eigvalsh(block)[-1]) for block in (covariance[:3, :3], covariance[3:, 3:]))
        return bool(np.rad2deg(turn) <= self.deg and shift <= self.m)


def parse_consumers(texts: Sequence[str]) -> tuple[Consumer, ...]:
    """Texts "NAME DEG M" -> consumers. ConfigError for another form, tolerances that are no positive numbers, or a name twice."""
    found: dict[str, Consumer] = {}
    for text in texts:
        words, deg, m = text.split(), math.nan, math.nan
        with suppress(ValueError):
            deg, m = map(float, words[1:])
        if not (0 < deg < math.inf and 0 < m < math.inf):
            raise ConfigError(f"consumers: {text!r} must be NAME DEG M with tolerances above 0, such as 'planner 0.5 0.10'")
        if words[0] in found:
            raise ConfigError(f"consumers: {words[0]} is named twice; name each consumer once, such as 'planner 0.5 0.10'")
        found[words[0]] = Consumer(words[0], deg, m)
    return tuple(found.values())

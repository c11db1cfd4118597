"""Consumers state tolerances, and an extrinsic serves those whose tolerances it keeps along every direction."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.errors import ConfigError
from calib_ros.result import Consumer, parse_consumers

SIGMA = np.array([0.1, 0.1, 0.2, 0.01, 0.01, 0.04])  # deg and m, before it is turned
UNITS = np.r_[np.deg2rad(np.ones(3)), np.ones(3)]


def covariance(turned: bool = True) -> np.ndarray:
    """Of SIGMA along oblique axes."""
    R = se3.exp([0.4, -0.9, 0.7, 0, 0, 0])[:3, :3] if turned else np.eye(3)
    A = np.kron(np.eye(2), R)
    return A @ np.diag((SIGMA * UNITS) ** 2) @ A.T


@pytest.mark.parametrize("turned", [False, True])
def test_two_standard_deviations_along_the_worst_direction_count(turned: bool) -> None:
    for deg, m, served in ((0.41, 0.081, True), (0.39, 0.081, False), (0.41, 0.079, False)):
        assert Consumer("planner", deg, m).is_served(covariance(turned)) is served
    assert not Consumer("planner", 99, 99).is_served(None)


def test_texts_are_read() -> None:
    assert parse_consumers(["planner 0.5 0.10", " fusion  .1  2e-2 "]) == (
        Consumer("planner", 0.5, 0.1),
        Consumer("fusion", 0.1, 0.02),
    )
    assert parse_consumers([]) == ()


@pytest.mark.parametrize(
    "text", ["", "planner", "planner 0.5", "0.5 0.1", "a b 0.5 0.1", "a 0 1", "a 1 -1", "a nan 1", "a 1 inf"]
)
def test_other_texts_are_refused_with_the_form(text: str) -> None:
    with pytest.raises(ConfigError, match=r"must be NAME DEG M .*'planner 0.5 0.10'"):
        parse_consumers(["fusion 0.1 0.02", text])
    with pytest.raises(ConfigError, match="planner is named twice"):
        parse_consumers(["planner 0.5 0.10", "planner 1 1"])

"""Edges between two LiDARs, of scans of a room with pillars: registered, and by motion alone."""

from __future__ import annotations

import numpy as np
import pytest
from room import STILL, TRUE, WRONG, drive, scans

from calib_ros import se3
from calib_ros.errors import TooFewFeaturesError
from calib_ros.frame import NANOSECONDS
from calib_ros.rig.graph import Edge
from calib_ros.rig.lidars import SHARED, LidarScans, motion_edge, scan_edge, shared_view

TURNED = TRUE @ se3.exp([0, 0, np.pi, 0, 0, 0])


def squared(edge: Edge, true: np.ndarray = TRUE) -> float:
    """Of its error, by its covariance."""
    xi = se3.log(true @ se3.inverse(edge.T))
    return float(xi @ np.linalg.solve(edge.covariance, xi))


def test_scans_are_registered_within_their_covariance_and_likewise_from_either_side() -> None:
    poses = drive(8)
    a, b = scans(poses, np.eye(4), 1), scans(poses, TRUE, 2)
    assert shared_view(a, b, WRONG @ TRUE) > SHARED
    edge = scan_edge(("a", a), ("b", b), WRONG @ TRUE)
    assert se3.rotation_error_deg(TRUE, edge.T) < 0.05
    assert se3.translation_error_m(TRUE, edge.T) < 0.01
    assert squared(edge) < 22.5  # chi^2 of 6, one in a thousand
    assert edge.samples == 8
    assert (edge.target, edge.source, edge.kind) == ("a", "b", "scans")
    other = scan_edge(("b", b), ("a", a), se3.inverse(WRONG @ TRUE))
    np.testing.assert_allclose(edge.T, se3.inverse(other.T), atol=2e-3)


def test_an_offset_of_the_clocks_is_not_taken_for_a_place() -> None:
    """b stamps 20 ms late, so that its scans seem to be of later: the speed must tell it from a shift."""
    poses = [se3.exp([0, 0, 0, 0.15 * k + 0.02 * k * k - 4, -3, 0]) for k in range(10)]  # accelerating from 1.5 m/s
    a, b = scans(poses, np.eye(4), 1), scans(poses, TRUE, 2)
    b = LidarScans([(stamp + 20_000_000, cloud) for stamp, cloud in b.scans], STILL)
    edge = scan_edge(("a", a), ("b", b), TRUE)
    assert edge.time_offset_s is not None
    assert edge.time_sigma_s is not None
    assert edge.time_offset_s < -2 * edge.time_sigma_s  # measured earlier than stamped
    assert squared(edge) < 22.5 + (0.02 / STILL.time_offset_sigma_s) ** 2


def test_scanners_that_look_apart_are_joined_by_motion() -> None:
    poses = drive(60)
    a, b = scans(poses, np.eye(4), 1, side=1), scans(poses, TURNED, 2, side=1)
    edge = motion_edge(("a", a), ("b", b), WRONG @ TURNED)
    assert se3.rotation_error_deg(TURNED, edge.T) < 1.0
    assert squared(edge, TURNED) < 22.5
    assert edge.kind == "motion"


def test_without_turns_places_are_not_told_by_motion() -> None:
    poses = [se3.exp([0, 0, 0, 0.3 * k - 6, -3, 0]) for k in range(40)]
    edge = motion_edge(("a", scans(poses, np.eye(4), 1)), ("b", scans(poses, TRUE, 2)), TRUE)
    assert np.sqrt(np.diag(edge.covariance)[3:]).max() > 0.5  # m


def test_failures_say_what_to_do() -> None:
    poses = drive(3)
    a, b = scans(poses, np.eye(4), 1), scans(poses, TRUE, 2, 60 * NANOSECONDS)
    with pytest.raises(TooFewFeaturesError, match="a and b: no two of their scans are of the same moment; give scans"):
        scan_edge(("a", a), ("b", b), TRUE)
    with pytest.raises(TooFewFeaturesError, match=r"were not recorded at the same time|moved too little"):
        motion_edge(("a", a), ("b", b), TRUE)
    assert shared_view(a, b, se3.exp([0, 0, 0, 25, 25, 25])) < SHARED

"""Trackers in the states that tests begin from, and estimates for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.online.monitor import Assessment, Verdict
from calib_ros.online.pose_filter import SYSTEMATIC_COVARIANCE
from calib_ros.online.sensor_health import SensorFault, SensorProblem
from calib_ros.online.tracker import Tracker
from calib_ros.result import CONVERGED, INITIAL, REFUSED, TENTATIVE, Extrinsic, Result

T = se3.exp([0.1, -1.2, 0.9, 0.27, -0.05, 0.1])
STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
USUAL_DEG, USUAL_M = 0.03, 0.006


def variances(deg: object = USUAL_DEG, m: object = USUAL_M) -> np.ndarray:
    """(6, 6) of standard deviations, of all axes or of each, with the bias of every estimate where there is any."""
    sigma = np.concatenate([np.deg2rad(np.broadcast_to(deg, 3)), np.broadcast_to(m, 3)])
    return np.diag(sigma**2) + SYSTEMATIC_COVARIANCE * (sigma > 0)


def at(by: tuple = STILL) -> np.ndarray:
    """T after a left twist, deg and m."""
    return se3.exp(np.concatenate([np.deg2rad(by[0]), by[1]])) @ T


def turned(deg: float) -> tuple:
    return ((deg, 0, 0), (0, 0, 0))


def estimate(by: tuple = STILL, deg: object = USUAL_DEG, m: object = USUAL_M, status: str = CONVERGED, **more) -> Result:
    return Result(at(by), status, **{"score": 0.8, "covariance": variances(deg, m), "frames_used": 7, **more})


def twist(a: np.ndarray, b: np.ndarray = T) -> tuple[np.ndarray, np.ndarray]:
    """From b to a, deg and m."""
    xi = se3.log(a @ se3.inverse(b))
    return np.rad2deg(xi[:3]), xi[3:]


def is_at(tracker: Tracker, by: tuple, deg: float, m: float) -> bool:
    off = twist(tracker.T, at(by))
    return np.abs(off[0]).max() < deg and np.abs(off[1]).max() < m


REFUSAL, FAR = estimate(status=REFUSED, reason="no optimum"), estimate(((0, 2, 0), (0, 0, 0)))


def tracking(initial: Result, current: Result | None = None) -> Tracker:
    """A tracker that trusts the first estimate."""
    config = Config()
    return Tracker(initial, current, replace(config, tracker=replace(config.tracker, confirmations=0)))


def unknown() -> Tracker:
    return tracking(Result(T, INITIAL, "no estimate yet"))


def settled() -> Tracker:
    """Two estimates agree, at T."""
    tracker = unknown()
    for _ in range(2):
        tracker.update(estimate())
    assert tracker.settled
    return tracker


def played(tracker: Tracker, *steps: Result | Verdict) -> list[str]:
    """The status after each estimate, and after each verdict of the monitor."""
    done = (tracker.update(step) if isinstance(step, Result) else tracker.apply(assessment(step)) for step in steps)
    return [extrinsic.result.status for extrinsic in done]


def blind(tracker: Tracker, message: str) -> Extrinsic:
    """The camera shows nothing, or both sensors work ("")."""
    return tracker.set_sensor_problem(SensorProblem(SensorFault.CAMERA_BLIND, message) if message else None)


def assessment(verdict: Verdict, text: str = "in words", p_value: float = 1e-5) -> Assessment:
    return Assessment(verdict, text, p_value, 3)


def confirming(config: Config | None = None) -> Tracker:
    """A tracker that has accepted its first estimate."""
    tracker = Tracker(Result(T, INITIAL), config=config)
    extrinsic = tracker.update(estimate())
    assert (extrinsic.result.status, extrinsic.usable, tracker.monitored) == (TENTATIVE, False, True)
    return tracker


def consistent(tracker: Tracker, keyframes: int) -> Extrinsic:
    for _ in range(keyframes):
        tracker.apply(assessment(Verdict.CONSISTENT))
    return tracker.current

"""Answers of checks of a fleet that never drove: estimates of known extrinsics with known covariances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros import se3
from calib_ros.registration.initial_guess import nominal
from calib_ros_check.fleet.recordings import Recording
from calib_ros_check.jobs.pool import Answer
from calib_ros_check.outcome import CheckResult, Tolerance
from calib_ros_check.tolerance import judge

SIGMA = np.r_[np.deg2rad([0.05] * 3), [0.01] * 3]
DAY = 86_400 * 10**9
START = 1_760_000_000 * 10**9


def checked(vehicle: str, number: int, T: np.ndarray, rng: np.random.Generator, factor: float = 1.0) -> tuple[Recording, Answer]:
    """The recording of a day and its answer: `nominal()` was checked, T (4, 4) is true."""
    recording = Recording(f"/data/{vehicle}/drive_{number:02d}", vehicle, START + DAY * number, "f")
    C = np.diag((factor * SIGMA) ** 2)
    estimate = se3.exp(factor * SIGMA * rng.standard_normal(6)) @ T
    found = judge(nominal(), estimate, C, Tolerance())
    result = CheckResult(
        *(found.verdict, "said", Tolerance(), nominal(), estimate, C, found.p_within),
        *(found.rotation, found.translation, found.axes),
        frames_used=10,
        data_stamp=recording.modified_ns,
    )
    return recording, {"result": result.to_dict(), "cpu_s": 10.0, "bytes_read": 2_000_000, "peak_bytes": 300_000_000}


def broken(vehicle: str, number: int, message: str = "it is broken") -> tuple[Recording, Answer]:
    """A recording that could not be checked."""
    return Recording(f"/data/{vehicle}/drive_{number:02d}", vehicle, START + DAY * number, "f"), {
        "error": message,
        "from": "input",
    }


def moved(steps: Sequence[float]) -> np.ndarray:
    """`nominal()` turned and shifted by (6,), deg and m."""
    return se3.exp(np.r_[np.deg2rad(steps[:3]), steps[3:]]) @ nominal()

"""Certificates: a verdict about every calibration, from the checks of all recordings that it is of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros_check.fleet.history import ERROR, ERRORS, VERDICTS, Row, Vehicle
from calib_ros_check.outcome import CheckVerdict, Deviation, Tolerance
from calib_ros_check.tolerance import Judgement, judge, reason_of, unknown

WORST_FIRST = {CheckVerdict.PASS: 0, CheckVerdict.INCONCLUSIVE: 1, CheckVerdict.FAIL: 2}


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is known of a calibration, the vehicle of its recordings.

    verdict: of CheckVerdict, or "error" where none of its recordings could be checked. T_checked, T_found: (4, 4), as claimed,
    and as all recordings together show it; None where unknown. shown: the recording whose frames tell most.
    """

    vehicle: Vehicle
    verdict: str
    reason: str
    judgement: Judgement
    T_checked: Transform | None = None
    T_found: Transform | None = None
    cause: str | None = None
    shown: Row | None = None

    @property
    def frames(self) -> int:
        """That the verdict rests on."""
        return sum(row.frames for row in self.vehicle.rows)

    def values(self) -> dict[str, Any]:
        """A line of certificates.csv."""
        rows = self.vehicle.rows
        deviations = (self.judgement.rotation, self.judgement.translation, *self.judgement.axes)
        known = [None if np.isnan(x) else x for own in deviations for x in (own.error, own.low, own.high)]
        counts = Counter(row.verdict for row in rows)
        return {
            "calibration": self.vehicle.name,
            "verdict": self.verdict,
            "cause": self.cause,
            **dict(zip(ERRORS, known, strict=True)),
            "recordings": len(rows),
            **{f"recordings_{verdict}": counts[verdict] for verdict in VERDICTS},
            "frames": self.frames,
            "changes": len(self.vehicle.changes),
            "outliers": sum(row.outlier for row in rows),
            "message": self.reason,
        }


def certificate_of(own: Vehicle, tolerance: Tolerance) -> Certificate:
    """A single recording speaks for itself; several by what they show together."""
    checked = [row for row in own.rows if row.verdict != ERROR]
    if not checked:
        return Certificate(own, ERROR, own.rows[0].message, unknown())
    best = max(checked, key=lambda row: (row in own.known, row.frames))
    result = best.result
    T = np.array(result["T_checked"])
    if len(own.known) <= 1:
        T_found = None if result["T_estimated"] is None else np.array(result["T_estimated"])
        return Certificate(own, best.verdict, best.message, _judged_before(result), T, T_found, best.cause, best)
    judged = [(judge(T, T_found, C, tolerance), T_found) for T_found, C in _pooled(own)]
    judgement, T_found = max(judged, key=lambda pair: (WORST_FIRST[pair[0].verdict], pair[0].rotation.error))
    verdict, reason = judgement.verdict.value, reason_of(judgement, tolerance, None)
    cause, count = Counter(row.cause for row in checked).most_common(1)[0]
    if cause and 2 * count > len(checked):
        verdict = CheckVerdict.FAIL.value
        reason = next(row.message for row in checked if row.cause == cause)
    if own.changes:
        reason = f"the sensors moved {len(own.changes)} times while the calibration stayed; at worst: {reason}"
    return Certificate(own, verdict, reason, judgement, T, T_found, cause, best)


def _pooled(own: Vehicle) -> list[tuple[Transform, Matrix]]:
    """T_camera_lidar (4, 4) of each segment between changes, and the covariance (6, 6) of its left twist. What intrinsics and
    clocks leave open is common to all recordings, and no more certain for their number."""
    first = np.array(own.known[0].result["T_estimated"])
    R = Rotation.from_rotvec(own.sequence.values[0, :3]).as_matrix().T @ first[:3, :3]
    t = first[:3, 3] - own.sequence.values[0, 3:]
    open_parts = [row.result["shared_covariance"] for row in own.known]
    shared = np.mean([np.zeros((6, 6)) if C is None else np.array(C) for C in open_parts], axis=0)
    out = []
    for mean, C in zip(own.segments.means, own.segments.covariances, strict=True):
        T = se3.from_parts(Rotation.from_rotvec(mean[:3]).as_matrix() @ R, t + mean[3:])
        back = np.linalg.inv(se3.parts_jacobian(T))
        out.append((T, back @ C @ back.T + shared))
    return out


def _judged_before(result: Mapping[str, Any]) -> Judgement:
    """What a check has found, out of its JSON."""

    def read(own: Mapping[str, Any]) -> Deviation:
        numbers = {name: np.nan if own[name] is None else own[name] for name in ("error", "low", "high")}
        return Deviation(own["name"], CheckVerdict(own["verdict"]), **numbers, words=own["words"])

    rotation, translation, *axes = map(read, (result["rotation"], result["translation"], *result["axes"]))
    p = np.nan if result["p_within"] is None else result["p_within"]
    return Judgement(CheckVerdict(result["verdict"]), p, rotation, translation, tuple(axes))

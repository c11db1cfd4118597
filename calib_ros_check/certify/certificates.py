"""Certificates: a verdict about every calibration, from the checks of all recordings that it is of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros_check.certify.claims import Claim
from calib_ros_check.fleet.fleet import exit_code_of
from calib_ros_check.fleet.history import Vehicle, VehicleChange
from calib_ros_check.fleet.rows import ERROR, ERRORS, VERDICTS, Row
from calib_ros_check.outcome import CheckVerdict, Deviation, Tolerance
from calib_ros_check.tolerance import Judgement, judge, reason_of, unknown

CSV, RECORDINGS, CHANGES, PAGE = "certificates.csv", "recordings.csv", "changes.csv", "certificates.html"
WORST_FIRST = {CheckVerdict.PASS: 0, CheckVerdict.INCONCLUSIVE: 1, CheckVerdict.FAIL: 2}


@dataclass(frozen=True, eq=False)
class Certificate:
    """What is known of a calibration.

    verdict: of CheckVerdict, or "error" where none of its recordings could be checked. T_checked, T_found: (4, 4), as claimed,
    and as all recordings together show it; None where unknown. rows: of its recordings, by time. shown: the claim whose frames
    tell most.
    """

    name: str
    verdict: str
    reason: str
    judgement: Judgement
    vehicle: Vehicle
    T_checked: Transform | None = None
    T_found: Transform | None = None
    cause: str = ""
    shown: Claim | None = None

    @property
    def rows(self) -> Sequence[Row]:
        """Of its recordings."""
        return self.vehicle.rows

    @property
    def changes(self) -> Sequence[VehicleChange]:
        """Of the extrinsic while the calibration stayed the same."""
        return self.vehicle.changes

    @property
    def frames(self) -> int:
        """That the verdict rests on."""
        return sum(row.frames for row in self.rows)

    def values(self) -> dict[str, Any]:
        """A line of certificates.csv."""
        deviations = (self.judgement.rotation, self.judgement.translation, *self.judgement.axes)
        known = [None if np.isnan(x) else x for own in deviations for x in (own.error, own.low, own.high)]
        counts = Counter(row.verdict for row in self.rows)
        return {
            "calibration": self.name,
            "verdict": self.verdict,
            "cause": self.cause or None,
            **dict(zip(ERRORS, known, strict=True)),
            "recordings": len(self.rows),
            **{f"recordings_{verdict}": counts[verdict] for verdict in VERDICTS},
            "frames": self.frames,
            "changes": len(self.changes),
            "outliers": sum(row.outlier for row in self.rows),
            "message": self.reason,
        }


@dataclass(frozen=True, eq=False)
class Certified:
    """certificates: what wants attention first. scatter: (6,), as of `Fleet`, rad and m. files: what was written."""

    certificates: Sequence[Certificate]
    scatter: Matrix
    files: Sequence[Path] = ()
    notes: Sequence[str] = ()

    @property
    def exit_code(self) -> int:
        """See `exit_code_of`."""
        return exit_code_of([own.verdict for own in self.certificates])


def certificate_of(own: Vehicle, results: Mapping[str, Any], claims: Mapping[str, Claim], tolerance: Tolerance) -> Certificate:
    """A single recording speaks for itself; several by what they show together."""
    known = [row for row in own.rows if row.verdict != ERROR]
    if not known:
        return Certificate(own.name, ERROR, own.rows[0].message, unknown(), own)
    best = max(known, key=lambda row: (row in own.known, row.frames))
    result, claim = results[best.path], claims[best.path]
    T = np.array(result["T_checked"])
    if len(own.known) <= 1:
        T_found = None if result["T_estimated"] is None else np.array(result["T_estimated"])
        said = (result["verdict"], result["reason"], _judged_before(result))
        return Certificate(own.name, *said, own, T, T_found, result["cause"] or "", claim)
    pooled = _pooled(own, results)
    judged = [(judge(T, T_found, C, tolerance), T_found) for T_found, C in pooled]
    judgement, T_found = max(judged, key=lambda pair: (WORST_FIRST[pair[0].verdict], pair[0].rotation.error))
    verdict, reason = judgement.verdict.value, reason_of(judgement, tolerance, None)
    causes = Counter(row.cause for row in known)
    cause, count = causes.most_common(1)[0]
    if cause and 2 * count > len(known):
        verdict = CheckVerdict.FAIL.value
        reason = next(results[row.path]["reason"] for row in known if row.cause == cause)
    if own.changes:
        reason = f"the sensors moved {len(own.changes)} times while the calibration stayed; at worst: {reason}"
    return Certificate(own.name, verdict, reason, judgement, own, T, T_found, cause or "", claim)


def _pooled(own: Vehicle, results: Mapping[str, Any]) -> list[tuple[Transform, Matrix]]:
    """T_camera_lidar (4, 4) of each segment between changes, and the covariance (6, 6) of its left twist. What intrinsics and
    clocks leave open is common to all recordings, and no more certain for their number."""
    first = np.array(results[own.known[0].path]["T_estimated"])
    R = Rotation.from_rotvec(own.sequence.values[0, :3]).as_matrix().T @ first[:3, :3]
    t = first[:3, 3] - own.sequence.values[0, 3:]
    open_parts = [results[row.path]["shared_covariance"] for row in own.known]
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

    rotation, translation = read(result["rotation"]), read(result["translation"])
    p = np.nan if result["p_within"] is None else result["p_within"]
    return Judgement(CheckVerdict(result["verdict"]), p, rotation, translation, tuple(read(axis) for axis in result["axes"]))

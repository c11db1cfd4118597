"""What is known of each recording of a fleet, and what the recordings of a vehicle tell together: when its extrinsic changed, and
by how much; and of a calibration, whose recordings are those of a vehicle here, a certificate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime, timezone
from typing import Any

import numpy as np
from scipy.special import chdtrc, erfcinv

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.frame import NANOSECONDS
from calib_ros_check.fleet.changes import FALSE_ALARMS, Extrinsics, Segments, extrinsics, scatter, segments
from calib_ros_check.fleet.recordings import Recording
from calib_ros_check.jobs.pool import Answer
from calib_ros_check.outcome import CheckVerdict, Deviation, Tolerance
from calib_ros_check.tolerance import AXES, Judgement, judge, reason_of, unknown

ERROR = "error"  # the verdict where a recording could not be checked
# What wants attention first.
VERDICTS = (CheckVerdict.FAIL.value, ERROR, CheckVerdict.INCONCLUSIVE.value, CheckVerdict.PASS.value)
EARLIEST = 946_684_800 * NANOSECONDS  # 2000: what is stamped before has a clock that was never set
UNITS = {axis: "deg" if axis[0] == "r" else "m" for axis in AXES}
# Columns of the errors: in all, and along every axis.
ERRORS = tuple(
    f"{name}_{end}" for name, unit in {"rotation": "deg", "translation": "m", **UNITS}.items() for end in (unit, "low", "high")
)
MOST_SIGMAS = 38.0  # where probabilities end
OWN = ("of", "result")  # of a row, no columns
WORST_FIRST = {CheckVerdict.PASS: 0, CheckVerdict.INCONCLUSIVE: 1, CheckVerdict.FAIL: 2}


@dataclass
class Row:
    """What is known of a recording. None where it is not.

    time_ns: of its data, or, where that is not stamped by a clock that was set, of its files. errors: by column, `*_low` and
    `*_high` where one lies with 95 %. drift_*: against the same vehicle's recordings since its last change, before this one;
    `drift_sigma` by how many standard deviations (of one number) that is unlikely. changed: the first recording after a change.
    outlier: off, while those before and after it agree. of: what was checked. result: as of `CheckResult.to_dict`, empty for an
    error.
    """

    recording: str
    vehicle: str
    time: str
    verdict: str
    cause: str | None = None
    errors: Mapping[str, float | None] = field(default_factory=lambda: dict.fromkeys(ERRORS))
    time_offset_s: float | None = None
    time_offset_sigma_s: float | None = None
    drift_deg: float | None = None
    drift_m: float | None = None
    drift_sigma: float | None = None
    changed: bool = False
    outlier: bool = False
    frames: int = 0
    cpu_s: float = 0.0
    bytes_read: int = 0
    peak_bytes: int = 0
    message: str = ""
    path: str = ""
    time_ns: int = 0
    of: Recording = field(default_factory=lambda: Recording(""))
    result: Mapping[str, Any] = field(default_factory=dict)

    def values(self) -> dict[str, Any]:
        """By column of the tables."""
        columns: dict[str, Any] = {}
        for own in fields(self):
            columns |= self.errors if own.name == "errors" else {own.name: getattr(self, own.name)}
        return {name: value for name, value in columns.items() if name not in OWN}


def row_of(recording: Recording, answer: Answer) -> Row:
    """The row of a recording with its answer; what its vehicle's other recordings tell is added by `vehicles`."""
    result: Mapping[str, Any] = answer.get("result") or {}
    stamp = int(result.get("data_stamp") or 0)
    time_ns = stamp if stamp >= EARLIEST else recording.modified_ns
    row = Row(
        recording.name,
        recording.vehicle,
        utc(time_ns),
        result.get("verdict", ERROR),
        **{name: answer[name] for name in ("cpu_s", "bytes_read", "peak_bytes") if name in answer},
        message=answer.get("error") or result.get("reason", ""),
        path=recording.path,
        time_ns=time_ns,
        of=recording,
        result=result,
    )
    if result:
        row.cause, row.frames = result["cause"], result["frames_used"]
        row.time_offset_s, row.time_offset_sigma_s = result["time_offset_s"], result["time_offset_sigma_s"]
        deviations = (result["rotation"], result["translation"], *result["axes"])
        row.errors = dict(zip(ERRORS, (own[end] for own in deviations for end in ("error", "low", "high")), strict=True))
    return row


def utc(time_ns: int) -> str:
    """ISO 8601 to the second; empty for 0."""
    if not time_ns:
        return ""
    return datetime.fromtimestamp(time_ns // NANOSECONDS, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")


@dataclass(frozen=True, eq=False)
class VehicleChange:
    """The extrinsic of a vehicle changed between two recordings.

    value: (6,), rx, ry, rz (rad) and tx, ty, tz (m): the rotation vector of R_after R_before^T and t_after - t_before, in the
    camera's axes. covariance: (6, 6). confirmed: more than one recording shows it; the last one alone may be an outlier.
    """

    vehicle: str
    before: Row
    after: Row
    value: Matrix
    covariance: Covariance
    confirmed: bool

    @property
    def rotation_deg(self) -> float:
        """Size of the turn."""
        return float(np.rad2deg(np.linalg.norm(self.value[:3])))

    @property
    def translation_m(self) -> float:
        """Size of the shift."""
        return float(np.linalg.norm(self.value[3:]))

    @property
    def sigma(self) -> Matrix:
        """(6,) standard deviations, deg and m."""
        return np.asarray(np.sqrt(np.diag(self.covariance)) * np.r_[np.rad2deg([1.0] * 3), [1.0] * 3])


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A vehicle's recordings in the order of time.

    rows: all of them. known: those with an estimate, to which `sequence` belongs, without scatter, and `segments`, with it.
    """

    name: str
    rows: Sequence[Row]
    known: Sequence[Row]
    sequence: Extrinsics
    segments: Segments
    changes: Sequence[VehicleChange]


def vehicles(rows: Sequence[Row], false_alarms: float = FALSE_ALARMS) -> tuple[list[Vehicle], Matrix]:
    """Histories of all vehicles, by name, and the variances (6,) by which their recordings scatter, rad^2 and m^2.

    rows: of all recordings; their drift, and whether they changed or are outliers, is set here. false_alarms: changes reported
    per recording where there is none.
    """
    ordered: dict[str, list[Row]] = {name: [] for name in sorted({row.vehicle for row in rows})}
    for row in sorted(rows, key=lambda row: (row.time_ns, row.path, row.of.key)):
        ordered[row.vehicle].append(row)
    known = {
        name: [row for row in own if row.result and row.result["T_estimated"] and row.result["covariance"]]
        for name, own in ordered.items()
    }
    sequences = {
        name: extrinsics(*([row.result[part] for row in own] for part in ("T_estimated", "covariance")))
        for name, own in known.items()
    }
    variances = scatter(list(sequences.values()))
    out = []
    for name, own in known.items():
        sequence = sequences[name].with_scatter(variances)
        found = segments(sequence, false_alarms)
        _mark(own, sequence, found)
        newest_is_alone, changes = np.count_nonzero(found.labels == len(found.means) - 1) == 1, []
        for k, (before, after) in enumerate(found.changes):
            value, covariance = found.means[k + 1] - found.means[k], found.covariances[k + 1] + found.covariances[k]
            confirmed = not (after == len(own) - 1 and newest_is_alone)
            changes.append(VehicleChange(name, own[before], own[after], value, covariance, confirmed))
        out.append(Vehicle(name, ordered[name], own, sequences[name], found, changes))
    return out, variances


def _mark(known: Sequence[Row], sequence: Extrinsics, found: Segments) -> None:
    """Set what the others tell of each recording: its drift against those since the last change before it."""
    for k, row in enumerate(known):
        row.outlier = k in found.outliers
        row.changed = any(after == k for _, after in found.changes)
        label = found.labels[k]
        earlier = [i for i in range(k) if i not in found.outliers]
        same = [i for i in earlier if found.labels[i] == label] or [i for i in earlier if found.labels[i] == label - 1]
        if not same:
            continue
        W = np.linalg.inv(sequence.covariances[same])
        C = np.linalg.inv(W.sum(axis=0))
        drift = sequence.values[k] - C @ np.einsum("nij,nj->i", W, sequence.values[same])
        square = float(drift @ np.linalg.solve(C + sequence.covariances[k], drift))
        row.drift_deg = float(np.rad2deg(np.linalg.norm(drift[:3])))
        row.drift_m = float(np.linalg.norm(drift[3:]))
        row.drift_sigma = float(np.minimum(np.sqrt(2) * erfcinv(chdtrc(6, square)), MOST_SIGMAS))


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
        told = result["rotation"], result["translation"], *result["axes"]  # what the check has found, out of its JSON
        known: list[dict[str, Any]] = [{name: np.nan if value is None else value for name, value in one.items()} for one in told]
        turn, shift, *axes = (Deviation(**one | {"verdict": CheckVerdict(one["verdict"])}) for one in known)
        p_within = np.nan if result["p_within"] is None else result["p_within"]
        judgement = Judgement(CheckVerdict(result["verdict"]), p_within, turn, shift, tuple(axes))
        return Certificate(own, best.verdict, best.message, judgement, T, T_found, best.cause, best)
    # Each segment between changes. What intrinsics and clocks leave open is common to all recordings, and no more certain for
    # their number.
    first, base = np.array(own.known[0].result["T_estimated"]), own.sequence.values[0]
    R, t = se3.rotation_from_vector(base[:3]).T @ first[:3, :3], first[:3, 3] - base[3:]
    open_parts = [row.result["shared_covariance"] for row in own.known]
    shared = np.mean([np.zeros((6, 6)) if C is None else np.array(C) for C in open_parts], axis=0)
    judged = []
    for mean, C in zip(own.segments.means, own.segments.covariances, strict=True):
        T_found = se3.from_parts(se3.rotation_from_vector(mean[:3]) @ R, t + mean[3:])
        back = np.linalg.inv(se3.parts_jacobian(T_found))
        judged.append((judge(T, T_found, back @ C @ back.T + shared, tolerance), T_found))
    judgement, T_found = max(judged, key=lambda pair: (WORST_FIRST[pair[0].verdict], pair[0].rotation.error))
    verdict, reason = judgement.verdict.value, reason_of(judgement, tolerance, None)
    cause, count = Counter(row.cause for row in checked).most_common(1)[0]
    if cause and 2 * count > len(checked):
        verdict = CheckVerdict.FAIL.value
        reason = next(row.message for row in checked if row.cause == cause)
    if own.changes:
        reason = f"the sensors moved {len(own.changes)} times while the calibration stayed; at worst: {reason}"
    return Certificate(own, verdict, reason, judgement, T, T_found, cause, best)

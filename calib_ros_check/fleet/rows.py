"""The table of a fleet: one row per recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import datetime, timezone
from typing import Any

from calib_ros.frame import NANOSECONDS
from calib_ros_check.fleet.recordings import Recording
from calib_ros_check.jobs.journal import Answer
from calib_ros_check.outcome import CheckVerdict
from calib_ros_check.tolerance import AXES

ERROR = "error"  # the verdict where a recording could not be checked
# What wants attention first.
VERDICTS = (CheckVerdict.FAIL.value, ERROR, CheckVerdict.INCONCLUSIVE.value, CheckVerdict.PASS.value)
EARLIEST = 946_684_800 * NANOSECONDS  # 2000: what is stamped before has a clock that was never set
UNITS = {axis: "deg" if axis[0] == "r" else "m" for axis in AXES}
# Columns of the errors: in all, and along every axis.
ERRORS = tuple(
    f"{name}_{end}" for name, unit in {"rotation": "deg", "translation": "m", **UNITS}.items() for end in (unit, "low", "high")
)


@dataclass
class Row:
    """What is known of a recording. None where it is not.

    time_ns: of its data, or, where that is not stamped by a clock that was set, of its files. errors: by column, `*_low` and
    `*_high` where one lies with 95 %. drift_*: against the same vehicle's recordings since its last change, before this one;
    `drift_sigma` by how many standard deviations (of one number) that is unlikely. changed: the first recording after a change.
    outlier: off, while those before and after it agree.
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

    def values(self) -> dict[str, Any]:
        """By column of the tables."""
        columns: dict[str, Any] = {}
        for own in fields(self):
            columns |= self.errors if own.name == "errors" else {own.name: getattr(self, own.name)}
        return columns


COLUMNS = tuple(Row("", "", "", "").values())


def row_of(recording: Recording, answer: Answer) -> Row:
    """The row of a recording with its answer; what its vehicle's other recordings tell is added by `history`."""
    result: Mapping[str, Any] = answer.get("result") or {}
    stamp = int(result.get("data_stamp") or 0)
    time_ns = stamp if stamp >= EARLIEST else recording.modified_ns
    row = Row(
        recording.name,
        recording.vehicle,
        utc(time_ns),
        result.get("verdict", ERROR),
        cpu_s=answer.get("cpu_s", 0.0),
        bytes_read=answer.get("bytes_read", 0),
        peak_bytes=answer.get("peak_bytes", 0),
        message=answer.get("error") or result.get("reason", ""),
        path=recording.path,
        time_ns=time_ns,
    )
    if not result:
        return row
    row.cause, row.frames = result["cause"], result["frames_used"]
    row.time_offset_s, row.time_offset_sigma_s = result["time_offset_s"], result["time_offset_sigma_s"]
    deviations = [own for axis in (result["rotation"], result["translation"], *result["axes"]) for own in _ends(axis)]
    row.errors = dict(zip(ERRORS, deviations, strict=True))
    return row


def _ends(deviation: Mapping[str, float | None]) -> tuple[float | None, ...]:
    return deviation["error"], deviation["low"], deviation["high"]


def utc(time_ns: int) -> str:
    """ISO 8601 to the second; empty for 0."""
    if not time_ns:
        return ""
    return datetime.fromtimestamp(time_ns // NANOSECONDS, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")

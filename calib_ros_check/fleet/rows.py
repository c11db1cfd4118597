"""The table of a fleet: one row per recording; as CSV, and as Parquet where pyarrow is installed."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_type_hints

import numpy as np

from calib_ros.errors import MissingDependencyError
from calib_ros.frame import NANOSECONDS
from calib_ros.io import write_atomically
from calib_ros_check.fleet.recordings import Recording
from calib_ros_check.jobs.journal import Answer
from calib_ros_check.outcome import CheckVerdict
from calib_ros_check.tolerance import AXES

if TYPE_CHECKING:
    from calib_ros_check.fleet.history import VehicleChange

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
    deviations = (result["rotation"], result["translation"], *result["axes"])
    row.errors = dict(zip(ERRORS, (own[end] for own in deviations for end in ("error", "low", "high")), strict=True))
    return row


def utc(time_ns: int) -> str:
    """ISO 8601 to the second; empty for 0."""
    if not time_ns:
        return ""
    return datetime.fromtimestamp(time_ns // NANOSECONDS, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line per recording, with a header; empty where nothing is known."""
    write_table(path, list(COLUMNS), [row.values().values() for row in rows])


def write_changes(path: Path, changes: Sequence[VehicleChange]) -> None:
    """One line per change of a vehicle: between which recordings, how large, and its standard deviations, deg and m."""
    names = [f"{axis}_{unit}" for axis, unit in UNITS.items()]
    header = ["vehicle", "before", "time_before", "after", "time_after", "confirmed", "rotation_deg", "translation_m"]
    lines = []
    for own in changes:
        places = [own.vehicle, own.before.recording, own.before.time, own.after.recording, own.after.time, own.confirmed]
        value = np.r_[np.rad2deg(own.value[:3]), own.value[3:]]
        lines.append([*places, own.rotation_deg, own.translation_m, *value.tolist(), *own.sigma.tolist()])
    write_table(path, [*header, *names, *(f"{name}_sigma" for name in names)], lines)


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """The same as `write_csv`, with types. MissingDependencyError without pyarrow."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise MissingDependencyError("no fleet.parquet: it needs pyarrow: pip install pyarrow, or calib_ros[fleet]") from None
    kinds = {"str": pa.string(), "float": pa.float64(), "int": pa.int64(), "bool": pa.bool_()}
    hints = get_type_hints(Row)
    schema = pa.schema([(name, kinds[_plain(hints.get(name, float))]) for name in COLUMNS])
    table = pa.Table.from_pylist([row.values() for row in rows], schema=schema)
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    write_atomically(path, buffer.getvalue())


def _plain(hint: Any) -> str:
    """Name of a type, without None."""
    return next(str(one.__name__) for one in getattr(hint, "__args__", (hint,)) if one is not type(None))


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def write_table(path: Path, header: list[str], lines: Iterable[Iterable[Any]]) -> None:
    """As CSV, atomically; None is empty."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(map(_text, line) for line in lines)
    write_atomically(path, buffer.getvalue().encode("utf-8", "backslashreplace"))

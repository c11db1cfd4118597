"""What is asked of a fleet, and what comes of it, with its tables."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.io import write_atomically
from calib_ros_check.fleet.changes import FALSE_ALARMS
from calib_ros_check.fleet.history import ERROR, UNITS, VERDICTS, Certificate, Row, Vehicle, VehicleChange
from calib_ros_check.outcome import CheckVerdict
from calib_ros_check.recording import CheckOptions

AXES = [f"{axis}_{unit}" for axis, unit in UNITS.items()]
CHANGES = ("vehicle", "before", "time_before", "after", "time_after", "confirmed", "rotation_deg", "translation_m")


@dataclass(frozen=True)
class FleetOptions:
    """How a fleet is checked.

    sources: recordings, and folders of them. out: folder for tables, page and journal. options: of each check.
    vehicle_pattern: see `find_recordings`. false_alarms: changes reported per recording where there is none. workers:
    processes; None = one per core. scheduler: address of a Dask cluster instead. fresh: forget earlier answers. certified: frames
    of each calibration in a recording, where calibrations are certified, as vehicles; None = they are not.

    BadInputError for a number out of range.
    """

    sources: Sequence[str]
    out: Path
    options: CheckOptions = field(default_factory=CheckOptions)
    vehicle_pattern: str | None = None
    false_alarms: float = FALSE_ALARMS
    workers: int | None = None
    scheduler: str = ""
    fresh: bool = False
    certified: int | None = None

    def __post_init__(self) -> None:
        for option, value in (("--workers", self.workers), ("--frames", self.certified)):
            if value is not None and value < 1:
                raise BadInputError(f"{option} {value}: give at least 1")
        if not 0 < self.false_alarms < 0.5:
            raise BadInputError(f"--false-alarms {self.false_alarms:g} is out of range (0, 0.5) per recording")


@dataclass(frozen=True, eq=False)
class Fleet:
    """vehicles: in the order of the tables. variances: (6,) between recordings beyond those of the checks, rad^2 and m^2.
    certificates: of the vehicles, if these are calibrations. files: what was written. notes: for people."""

    vehicles: Sequence[Vehicle]
    variances: Matrix
    certificates: Sequence[Certificate] = ()
    files: Sequence[Path] = ()
    notes: Sequence[str] = ()

    @property
    def rows(self) -> list[Row]:
        """All recordings, by vehicle and time."""
        return [row for own in self.vehicles for row in own.rows]

    @property
    def changes(self) -> list[VehicleChange]:
        """Of all vehicles, by time."""
        return sorted((one for own in self.vehicles for one in own.changes), key=lambda one: one.after.time_ns)

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of certificates, or recordings, by verdict, what wants attention first."""
        counted = Counter(own.verdict for own in self.certificates or self.rows)
        return {verdict: counted[verdict] for verdict in VERDICTS}

    @property
    def exit_code(self) -> int:
        """0 all pass, 1 any fails, 3 none fails and any is inconclusive or could not be checked, 2 none could be checked."""
        found = {verdict for verdict, count in self.counts.items() if count}
        if found <= {ERROR}:
            return 2
        if CheckVerdict.FAIL.value in found:
            return 1
        return 0 if found == {CheckVerdict.PASS.value} else 3


def write_csv(path: Path, lines: Sequence[Mapping[str, Any]], header: Iterable[str] | None = None) -> None:
    """Lines by column; empty where nothing is known."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(lines[0] if header is None else header)
    writer.writerows(map(_text, line.values()) for line in lines)
    write_atomically(path, buffer.getvalue().encode("utf-8", "backslashreplace"))


def write_changes(path: Path, changes: Sequence[VehicleChange]) -> None:
    """One line per change of a vehicle: between which recordings, how large, and its standard deviations, deg and m."""
    header = [*CHANGES, *AXES, *(f"{name}_sigma" for name in AXES)]
    lines = []
    for own in changes:
        places = [own.vehicle, own.before.recording, own.before.time, own.after.recording, own.after.time, own.confirmed]
        value = np.r_[np.rad2deg(own.value[:3]), own.value[3:]]
        told = [*places, own.rotation_deg, own.translation_m, *value.tolist(), *own.sigma.tolist()]
        lines.append(dict(zip(header, told, strict=True)))
    write_csv(path, lines, header)


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """One line per recording, with types. MissingDependencyError without pyarrow."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise MissingDependencyError("no fleet.parquet: it needs pyarrow: pip install pyarrow, or calib_ros[fleet]") from None
    # What is known of no recording, which its own value would not tell, is a number.
    kinds = {str: pa.string(), bool: pa.bool_(), int: pa.int64(), float: pa.float64(), type(None): pa.float64()}
    usual = Row("", "", "", "", cause="").values()
    schema = pa.schema([(name, kinds[type(value)]) for name, value in usual.items()])
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist([row.values() for row in rows], schema=schema), buffer, compression="zstd")
    write_atomically(path, buffer.getvalue())


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:.6g}" if isinstance(value, float) else str(value)

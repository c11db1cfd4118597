"""The tables of a fleet, written atomically: CSV, and Parquet where pyarrow is installed."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.errors import MissingDependencyError
from calib_ros.io import write_atomically
from calib_ros_check.fleet.history import UNITS, Row, VehicleChange

AXES = [f"{axis}_{unit}" for axis, unit in UNITS.items()]
CHANGES = ("vehicle", "before", "time_before", "after", "time_after", "confirmed", "rotation_deg", "translation_m")


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

"""The table of a fleet as files: CSV, and Parquet where pyarrow is installed."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from calib_ros.errors import MissingDependencyError
from calib_ros.io import write_atomically
from calib_ros_check.fleet.history import VehicleChange
from calib_ros_check.fleet.rows import COLUMNS, UNITS, Row

NO_PARQUET = "no fleet.parquet: it needs pyarrow: pip install pyarrow, or calib_ros[fleet]"


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line per recording, with a header; empty where nothing is known."""
    _write(path, list(COLUMNS), [[_text(value) for value in row.values().values()] for row in rows])


def write_changes(path: Path, changes: Sequence[VehicleChange]) -> None:
    """One line per change of a vehicle: between which recordings, how large, and its standard deviations, deg and m."""
    names = [f"{axis}_{unit}" for axis, unit in UNITS.items()]
    header = ["vehicle", "before", "time_before", "after", "time_after", "confirmed", "rotation_deg", "translation_m"]
    lines = []
    for own in changes:
        places = [own.vehicle, own.before.recording, own.before.time, own.after.recording, own.after.time, own.confirmed]
        value = np.r_[np.rad2deg(own.value[:3]), own.value[3:]]
        lines.append([*places, own.rotation_deg, own.translation_m, *value.tolist(), *own.sigma.tolist()])
    _write(path, [*header, *names, *(f"{name}_sigma" for name in names)], [[_text(one) for one in line] for line in lines])


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """The same as `write_csv`, with types. MissingDependencyError without pyarrow."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise MissingDependencyError(NO_PARQUET) from None
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


def _write(path: Path, header: list[str], lines: list[list[str]]) -> None:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(lines)
    write_atomically(path, buffer.getvalue().encode("utf-8", "backslashreplace"))

"""Results as CSV tables, for other programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from calib_ros.evaluation.curves import AXES
from calib_ros.evaluation.results import Results
from calib_ros.evaluation.trials.table import write_trials
from calib_ros.files import write_atomically

TRIALS, CURVES, PEAKS, COSTS = "trials.csv", "curves.csv", "peaks.csv", "costs.csv"


def write_tables(folder: Path, results: Results) -> list[Path]:
    """trials.csv (one row a calibration), curves.csv (one row a value), peaks.csv (where curves are highest), costs.csv.

    Each is replaced as a whole; of those without rows, earlier ones go.
    """
    written = []
    if results.trials:
        write_trials(folder / TRIALS, results.trials)
        written.append(folder / TRIALS)
    else:
        (folder / TRIALS).unlink(missing_ok=True)
    units = ["deg"] * 3 + ["cm"] * 3
    tables: dict[str, tuple[Sequence[str], list[Sequence[Any]]]] = {
        CURVES: (
            ("experiment", "method", "frames", "axis", "unit", "offset", "score"),
            [
                (c.experiment, c.method, c.label, name, unit, repr(float(x)), repr(float(y)))
                for c in results.curves
                for name, unit, xs, ys in zip(AXES, units, c.curves.offsets, c.curves.values, strict=True)
                for x, y in zip(xs, ys, strict=True)
            ],
        ),
        PEAKS: (
            ("experiment", "method", "frames", *(f"{name}_{unit}" for name, unit in zip(AXES, units, strict=True))),
            [(c.experiment, c.method, c.label, *(repr(float(x)) for x in c.curves.peaks)) for c in results.curves],
        ),
        COSTS: (
            ("method", "scene", "frames", "features_ms_per_frame", "evaluation_ms", "memory_mb"),
            [(c.method, c.scene, c.frames, c.features_ms_per_frame, c.evaluation_ms, c.memory_mb) for c in results.costs],
        ),
    }
    for name, (header, rows) in tables.items():
        if rows:
            write_atomically(folder / name, _csv(header, rows))
            written.append(folder / name)
        else:
            (folder / name).unlink(missing_ok=True)
    return written


def _csv(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()

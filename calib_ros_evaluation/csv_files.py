"""Results as CSV files, written for other programs and read again for comparison."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from calib_ros.errors import BadInputError
from calib_ros.io import write_atomically
from calib_ros_evaluation.results import COLUMNS, TWIST_AXES, TWISTS, Trial

TRIALS = "trials.csv"
STATUSES = ("done", "refused", "failed")
PLAIN = {"str": str, "int": int, "float": float}  # types of Trial's fields that are one column each


def write_trials(path: Path, trials: Sequence[Trial], succeeded: Callable[[Trial], bool] | None = None) -> None:
    """A row for each trial under a header, see COLUMNS; floats so that reading gives the same ones.

    succeeded: for the column success; None = Trial.success. The file is replaced as a whole; BadInputError if its folder cannot
    be written.
    """
    rows = []
    for trial in trials:
        row = [repr(float(value)) if isinstance(value, float) else value for value in trial.row()]
        if succeeded is not None:
            row[COLUMNS.index("success")] = int(succeeded(trial))
        rows.append(row)
    write_atomically(path, as_csv(COLUMNS, rows))


def read_rows(path: Path, columns: Sequence[str], advice: str) -> Iterator[tuple[str, dict[str, str]]]:
    """(file and line, values by column) of a CSV file; columns may stand in any order, with others between.

    BadInputError, with the line and the advice, if it cannot be read, a column is missing or a line is cut off.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}; {advice}") from None
    except UnicodeDecodeError:
        raise BadInputError(f"{path} is no text; {advice}") from None
    if not text.strip():
        raise BadInputError(f"{path} is empty; {advice}")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = next(reader)
        missing = [name for name in columns if name not in header]
        if missing:
            raise BadInputError(f"{path}, line 1: no column {', '.join(missing)}; {advice}")
        for row in reader:
            if len(row) != len(header):
                raise BadInputError(
                    f"{path}, line {reader.line_num}: {len(row)} values in {len(header)} columns; the line is cut off or damaged"
                )
            yield f"{path}, line {reader.line_num}", dict(zip(header, row, strict=True))
    except csv.Error as error:
        raise BadInputError(f"{path}, line {reader.line_num}: {error}; the file is cut off or damaged") from None
    if not text.endswith("\n"):
        raise BadInputError(f"{path}, line {reader.line_num}: the last line is cut off; copy the file again")


def read_trials(path: Path) -> list[Trial]:
    """Trials of a file that write_trials wrote, of this version or another. BadInputError as of read_rows, and if there are none,
    a value is none, or a trial is there twice."""
    trials: dict[tuple[object, ...], tuple[Trial, str]] = {}
    for where, values in read_rows(Path(path), COLUMNS, "give the trials.csv of an evaluation"):
        trial = _trial(values, where)
        _, first = trials.setdefault(trial.identity, (trial, where))
        if first != where:
            line = first.rpartition(", ")[2]
            raise BadInputError(f"{where}: the same trial as in {line}; give the trials.csv of one evaluation")
    if not trials:
        raise BadInputError(f"{path} holds no trials, only a header; was its evaluation broken off?")
    return [trial for trial, _ in trials.values()]


def _trial(values: dict[str, str], where: str) -> Trial:
    def parsed(name: str, kind: type, text: str) -> Any:
        try:
            return kind(text)
        except ValueError:
            number = "whole number" if kind is int else "number"
            raise BadInputError(f"{where}: {name} must be a {number}, got {text!r}") from None

    if values["status"] not in STATUSES:
        raise BadInputError(f"{where}: status must be one of {', '.join(STATUSES)}, got {values['status']!r}")
    known: dict[str, Any] = {"frames": tuple(parsed("frames", int, one) for one in values["frames"].split())}
    for twist in TWISTS:
        known[twist] = tuple(parsed(name, float, values[name]) for name in (f"{twist}_{axis}" for axis in TWIST_AXES))
    for field in fields(Trial):
        if field.name in COLUMNS and field.name not in known:
            known[field.name] = parsed(field.name, PLAIN[str(field.type)], values[field.name])
    return Trial(**known)


def as_csv(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    """A header and rows, as bytes of a CSV file."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode()

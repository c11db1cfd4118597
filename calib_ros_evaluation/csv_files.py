"""Results as CSV files, written for other programs and read again for comparison."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from calib_ros.errors import BadInputError
from calib_ros.io import write_atomically
from calib_ros_evaluation.results import COLUMNS, IDENTITY, STATUSES, trials_table

TRIALS = "trials.csv"
TEXTS = ("experiment", "method", "scene", "frames", "status", "reason")
WHOLE = ("seed", "success", "evaluations")
ADVICE = "give the trials.csv of an evaluation"


def write_table(path: Path, table: pd.DataFrame) -> None:
    """A row for each of the table's under a header; floats so that reading gives the same ones. The file is replaced as a whole;
    BadInputError if its folder cannot be written."""
    write_atomically(path, table.to_csv(index=False, na_rep="nan").encode())


def read_table(path: Path, columns: Sequence[str], advice: str) -> pd.DataFrame:
    """Texts of a CSV file; columns may stand in any order, with others between.

    BadInputError, with the advice, if it cannot be read, a column is missing or a line is cut off.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
        table = pd.read_csv(io.StringIO(text), dtype=object, keep_default_na=False)
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}; {advice}") from None
    except UnicodeDecodeError:
        raise BadInputError(f"{path} is no text; {advice}") from None
    except (pd.errors.EmptyDataError, pd.errors.ParserError) as error:
        raise BadInputError(f"{path} is empty, cut off or damaged ({str(error).strip()}); {advice}") from None
    missing = [name for name in columns if name not in table]
    if missing:
        raise BadInputError(f"{path}: no column {', '.join(missing)}; {advice}")
    if not text.endswith("\n"):
        raise BadInputError(f"{path}: the last line is cut off; copy the file again")
    return table


def numbers(table: pd.DataFrame, name: str, kind: Callable[[str], float], path: Path, advice: str) -> pd.Series:
    """What `kind` makes of the texts of a column. BadInputError, with the advice, for one of which it makes nothing."""
    try:
        return table[name].map(kind)
    except ValueError as error:
        raise BadInputError(f"{path}, column {name}: {error}; {advice}") from None


def read_trials(path: Path) -> pd.DataFrame:
    """Trials of a file that an evaluation wrote, of this version or another. BadInputError as of read_table, and if there are
    none, a value is none, or a trial is there twice."""
    table = read_table(path, COLUMNS, ADVICE)
    if table.empty:
        raise BadInputError(f"{path} holds no trials, only a header; was its evaluation broken off?")
    for name in COLUMNS:
        if name not in TEXTS:
            table[name] = numbers(table, name, int if name in WHOLE else float, path, ADVICE)
    numbers(table, "frames", lambda text: sum(map(int, text.split())), path, ADVICE)
    for said, is_so in (
        (f"status must be one of {', '.join(STATUSES)}", ~table.status.isin(STATUSES)),
        ("a trial that is there already; give the trials.csv of one evaluation", table.duplicated(list(IDENTITY))),
    ):
        if is_so.any():
            raise BadInputError(f"{path}, row {is_so.to_numpy().argmax() + 1}: {said}")
    return trials_table(table)

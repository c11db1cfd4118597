"""The check of a fleet: find its recordings, check those that have no answer yet, compare each vehicle's, write the tables."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros_check.fleet.changes import FALSE_ALARMS
from calib_ros_check.fleet.history import Vehicle, VehicleChange, vehicles
from calib_ros_check.fleet.jobs import OTHER, CheckJob, lost, options_key, run_checks
from calib_ros_check.fleet.page import page_of_fleet, write_page
from calib_ros_check.fleet.recordings import find_recordings
from calib_ros_check.fleet.rows import ERROR, VERDICTS, Row, row_of, write_changes, write_csv, write_parquet
from calib_ros_check.jobs.cluster import ClusterPool
from calib_ros_check.jobs.journal import Answer, Journal
from calib_ros_check.jobs.local import LocalPool
from calib_ros_check.jobs.pool import Pool, run
from calib_ros_check.outcome import CheckVerdict
from calib_ros_check.recording import REFERENCE, TF, CheckOptions

Progress = Callable[[int, int], None]
ABOUT = {"format": "calib-ros fleet 1"}  # of the journal: options and versions belong to its jobs
CSV, PARQUET, PAGE, CHANGES = "fleet.csv", "fleet.parquet", "fleet.html", "changes.csv"


@dataclass(frozen=True)
class FleetOptions:
    """How a fleet is checked.

    sources: recordings, and folders of them. out: folder for tables, page and journal. options: of each check.
    vehicle_pattern: see `find_recordings`. false_alarms: changes reported per recording where there is none. workers:
    processes; None = one per core. scheduler: address of a Dask cluster instead. fresh: forget earlier answers.

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

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise BadInputError(f"--workers {self.workers}: give at least 1")
        if not 0 < self.false_alarms < 0.5:
            raise BadInputError(f"--false-alarms {self.false_alarms:g} is out of range (0, 0.5) per recording")


@dataclass(frozen=True, eq=False)
class Fleet:
    """rows: all recordings, by vehicle and time. scatter: (6,), standard deviations between recordings beyond those of the
    checks, rad and m. files: what was written. notes: for people."""

    rows: Sequence[Row]
    vehicles: Sequence[Vehicle]
    scatter: NDArray[np.float64]
    files: Sequence[Path] = ()
    notes: Sequence[str] = ()

    @property
    def changes(self) -> list[VehicleChange]:
        """Of all vehicles, by time."""
        return sorted((one for own in self.vehicles for one in own.changes), key=lambda one: one.after.time_ns)

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of recordings by verdict, what wants attention first."""
        counted = Counter(row.verdict for row in self.rows)
        return {verdict: counted[verdict] for verdict in VERDICTS}

    @property
    def exit_code(self) -> int:
        """See `exit_code_of`."""
        return exit_code_of([row.verdict for row in self.rows])


def check_fleet(
    options: FleetOptions, facts: Mapping[str, str] | None = None, progress: Progress = lambda done, total: None
) -> Fleet:
    """Check all recordings that have not been, and write tables and page.

    Interrupted or killed at any moment, the same options go on where it stopped. A recording that cannot be read, or ends its
    worker again and again, is a row with the verdict "error". facts: for the head of the page. progress: called with the number
    of recordings that are done, and of all.

    Raises BadInputError for sources without recordings or a folder that cannot be written, MissingDependencyError, and what a
    pool raises that has no workers.
    """
    page_of_fleet()  # says what is missing before the work
    found = find_recordings(options.sources, options.vehicle_pattern)
    settings = options_key(options.options)
    jobs = [CheckJob(one.path, one.fingerprint, settings) for one in found]
    answers, notes = answers_of(jobs, options, "fleet check", progress)
    rows = [row_of(recording, answer) for recording, answer in zip(found, answers, strict=True)]
    results: dict[str, Any] = {row.path: answer.get("result") for row, answer in zip(rows, answers, strict=True)}
    histories, variances = vehicles(rows, results, options.false_alarms)
    ordered = [row for vehicle in histories for row in vehicle.rows]
    return _written(Fleet(ordered, histories, np.sqrt(variances)), options, facts or {}, notes)


def answers_of(jobs: Sequence[CheckJob], options: FleetOptions, what: str, progress: Progress) -> tuple[list[Answer], list[str]]:
    """The answers of all jobs, those of earlier runs out of the journal of `what` in options.out, and notes for people."""
    with Journal(options.out, ABOUT, options.fresh, what) as journal:
        # What failed for another reason than the recording may succeed now.
        for key in [key for key, answer in journal.done.items() if answer.get("from") == OTHER]:
            del journal.done[key]
        pool: Pool = ClusterPool(options.scheduler) if options.scheduler else LocalPool(options.workers or os.cpu_count() or 1)
        work = partial(run_checks, _portable(options.options))
        run([[job] for job in jobs], work, journal, pool, progress, lost)
        return [journal.done[job.key] for job in jobs], list(journal.notes)


def exit_code_of(verdicts: Sequence[str]) -> int:
    """0 all pass, 1 any fails, 3 none fails and any is inconclusive or could not be checked, 2 none could be checked."""
    found = set(verdicts)
    if found <= {ERROR}:
        return 2
    if CheckVerdict.FAIL.value in found:
        return 1
    return 0 if found == {CheckVerdict.PASS.value} else 3


def _written(fleet: Fleet, options: FleetOptions, facts: Mapping[str, str], notes: list[str]) -> Fleet:
    out = options.out
    write_csv(out / CSV, fleet.rows)
    write_changes(out / CHANGES, fleet.changes)
    files = [out / PAGE, out / CSV, out / CHANGES]
    try:
        write_parquet(out / PARQUET, fleet.rows)
        files.append(out / PARQUET)
    except MissingDependencyError as error:
        notes.append(str(error))
    write_page(out / PAGE, fleet, options, facts)
    return replace(fleet, files=files, notes=notes)


def _portable(options: CheckOptions) -> CheckOptions:
    """With absolute paths, since workers may have started elsewhere."""
    files = {"rig": options.rig, "extrinsic": "" if options.extrinsic in (REFERENCE, TF) else options.extrinsic}
    absolute: dict[str, Any] = {name: str(Path(file).expanduser().resolve()) for name, file in files.items() if file}
    return replace(options, **absolute)

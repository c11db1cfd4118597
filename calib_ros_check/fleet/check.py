"""The check of a fleet: find its recordings, check those that have no answer yet, compare those of each vehicle, and write."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from calib_ros.errors import MissingDependencyError
from calib_ros_check.fleet.certificates import certificate_of
from calib_ros_check.fleet.fleet import Fleet, FleetOptions, write_changes, write_csv, write_parquet
from calib_ros_check.fleet.history import VERDICTS, Row, row_of, vehicles
from calib_ros_check.fleet.jobs import OTHER, lost, options_key, run_checks
from calib_ros_check.fleet.page import TEMPLATE, write_fleet_page
from calib_ros_check.fleet.recordings import find_claims, find_recordings
from calib_ros_check.jobs.pool import Journal, run
from calib_ros_check.page import page_template
from calib_ros_check.recording import REFERENCE, TF, CheckOptions

Progress = Callable[[int, int], None]
ABOUT = {"format": "calib-ros fleet 1"}  # of the journal: options and versions belong to its jobs


def check_fleet(
    options: FleetOptions, facts: Mapping[str, str] | None = None, progress: Progress = lambda done, total: None
) -> Fleet:
    """Check all recordings that have not been, and write tables and page.

    Interrupted or killed at any moment, the same options go on where it stopped. A recording that cannot be read, or ends its
    worker again and again, is a row with the verdict "error". facts: for the head of the page. progress: called with the number
    of recordings that are done, and of all.

    Raises BadInputError for sources without recordings or a folder that cannot be written, MissingDependencyError, and what
    `run` raises without workers.
    """
    page_template(TEMPLATE)  # says what is missing before the work
    rows, notes = _checked(options, progress)
    histories, variances = vehicles(rows, options.false_alarms)
    certificates = []
    if options.certified is not None:
        certificates = [certificate_of(own, options.options.tolerance) for own in histories]
        certificates.sort(key=lambda own: (VERDICTS.index(own.verdict), own.vehicle.name))
        histories = [own.vehicle for own in certificates]
    fleet, out = Fleet(histories, variances, certificates, notes=notes), options.out
    page, table = (out / f"{'certificates' if certificates else 'fleet'}.{end}" for end in ("html", "csv"))
    files = [page, table, out / "changes.csv"]
    write_csv(table, [own.values() for own in certificates or fleet.rows])
    write_changes(files[-1], fleet.changes)
    try:
        if certificates:
            files.insert(2, out / "recordings.csv")
            write_csv(files[2], [row.values() for row in fleet.rows])
        else:
            write_parquet(out / "fleet.parquet", fleet.rows)
            files.append(out / "fleet.parquet")
    except MissingDependencyError as error:
        notes.append(str(error))
    write_fleet_page(page, fleet, options, facts or {})
    return replace(fleet, files=files)


def _checked(options: FleetOptions, progress: Progress) -> tuple[list[Row], list[str]]:
    """All recordings with their answers, those of earlier runs out of the journal, and notes for people."""
    settings = options_key(options.options)
    if options.certified is None:
        found, what = find_recordings(options.sources, options.vehicle_pattern), "fleet check"
    else:
        found, what = find_claims(options.sources, options.options, options.certified), "certification"
    jobs = [replace(one, options=settings) for one in found]
    with Journal(options.out, ABOUT, options.fresh, what) as journal:
        # What failed for another reason than the recording may succeed now.
        for key in [key for key, answer in journal.done.items() if answer.get("from") == OTHER]:
            del journal.done[key]
        work, workers = partial(run_checks, _portable(options.options)), options.workers or os.cpu_count() or 1
        run([[job] for job in jobs], work, journal, progress, workers, options.scheduler, lost)
        return [row_of(job, journal.done[job.key]) for job in jobs], list(journal.notes)


def _portable(options: CheckOptions) -> CheckOptions:
    """With absolute paths, since workers may have started elsewhere."""
    files = {"rig": options.rig, "extrinsic": "" if options.extrinsic in (REFERENCE, TF) else options.extrinsic}
    absolute: dict[str, Any] = {name: str(Path(file).expanduser().resolve()) for name, file in files.items() if file}
    return replace(options, **absolute)

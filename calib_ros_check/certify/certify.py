"""Every calibration of data sets: checked, written as a page and tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calib_ros_check.certify.certificates import CHANGES, CSV, PAGE, RECORDINGS, Certified, certificate_of
from calib_ros_check.certify.claims import find_claims
from calib_ros_check.certify.page import page_of_certificates, write_certificates
from calib_ros_check.fleet.fleet import FleetOptions, Progress, answers_of
from calib_ros_check.fleet.history import vehicles
from calib_ros_check.fleet.jobs import CheckJob, options_key
from calib_ros_check.fleet.rows import VERDICTS, row_of, write_changes, write_csv, write_table
from calib_ros_check.recording import FRAMES


def certify(
    options: FleetOptions,
    frames: int = FRAMES,
    facts: Mapping[str, str] | None = None,
    progress: Progress = lambda done, total: None,
) -> Certified:
    """Check every calibration of data sets, and write page and tables; options.vehicle_pattern is not used. frames: of each
    calibration in a recording.

    Goes on where it was interrupted, and raises, as `check_fleet`.
    """
    page_of_certificates()  # says what is missing before the work
    settings = options_key(options.options)
    claims = find_claims(options.sources, options.options, frames)
    jobs = [CheckJob(c.recording.path, c.recording.fingerprint, settings, c.camera, c.frames) for c in claims]
    answers, notes = answers_of(jobs, options, "certification", progress)
    rows = [row_of(claim.recording, answer) for claim, answer in zip(claims, answers, strict=True)]
    for row, job in zip(rows, jobs, strict=True):
        row.path = job.key  # recordings with several cameras or calibrations have several rows
    results: dict[str, Any] = {job.key: answer.get("result") for job, answer in zip(jobs, answers, strict=True)}
    histories, variances = vehicles(rows, results, options.false_alarms)
    by_key = {job.key: claim for job, claim in zip(jobs, claims, strict=True)}
    found = [certificate_of(own, results, by_key, options.options.tolerance) for own in histories]
    found.sort(key=lambda own: (VERDICTS.index(own.verdict), own.name))
    for row, claim in zip(rows, claims, strict=True):
        row.path = claim.recording.path
    out = options.out
    header = list(found[0].values())
    write_table(out / CSV, header, [own.values().values() for own in found])
    write_csv(out / RECORDINGS, [row for own in found for row in own.rows])
    write_changes(out / CHANGES, [change for own in found for change in own.changes])
    certified = Certified(found, np.sqrt(variances), [out / name for name in (PAGE, CSV, RECORDINGS, CHANGES)], notes)
    write_certificates(out / PAGE, certified, options, facts or {})
    return certified

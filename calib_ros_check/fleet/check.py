"""The check of a fleet: find its recordings, check those that have no answer yet, compare those of each vehicle, and write."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from calib_ros.datasets.nuscenes import split_scene
from calib_ros.errors import CalibrationError, MissingDependencyError
from calib_ros.result import VERSION
from calib_ros.rig.description import read_rig
from calib_ros_check.fleet.fleet import Fleet, FleetOptions, write_changes, write_csv, write_parquet
from calib_ros_check.fleet.history import VERDICTS, Row, certificate_of, row_of, vehicles
from calib_ros_check.fleet.page import TEMPLATE, write_fleet_page
from calib_ros_check.fleet.recordings import Recording, find_claims, find_recordings
from calib_ros_check.jobs.pool import Answer, Journal, run
from calib_ros_check.page import page_template
from calib_ros_check.recording import REFERENCE, TF, CheckOptions, check_source
from calib_ros_check.rig.check import as_given, as_row, check_recording

# What an error comes from: the recording, which stays as it is until its files change, or anything else, which is tried again.
INPUT, OTHER = "input", "other"
Progress = Callable[[int, int], None]
ABOUT = {"format": "calib-ros fleet 1"}  # of the journal: options and versions belong to its jobs


def options_key(options: CheckOptions) -> str:
    """The same for options, and files that they name, that give the same answers. BadInputError if the extrinsic is a file that
    cannot be read."""
    content, semantics = {**asdict(options), "weights": list[str | None]()}, options.config.semantics
    try:
        from calib_ros_semantics.models.segmentation import SegmentationModels
        from calib_ros_semantics.models.weight_sets import weights_of
    except ImportError:  # no package brings models
        pass
    else:
        found = [model.weights for model in SegmentationModels(semantics).models]
        found.append(weights_of(Path(semantics.segment_anything_decoder)))
        content["weights"] = [None if own is None else own.sha256 for own in found]
    if options.rig:
        description = as_given(read_rig(options.rig), options.extrinsic)
        content["rig"] = repr((description.sensors, description.reference, description.pairs))
    elif options.extrinsic not in (REFERENCE, TF):
        from calib_ros import result

        content["extrinsic"] = result.load(options.extrinsic).T_camera_lidar.tolist()
    text = json.dumps({"version": VERSION, **content}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_checks(options: CheckOptions, jobs: Sequence[Recording]) -> list[Answer]:
    """Check recordings: `result` as of `CheckResult.to_dict`, or `error` and where it comes from; `cpu_s`, `bytes_read` and
    `peak_bytes` of the process, 0 where the system does not tell.

    Raises MissingDependencyError and ImportError only: no recording would fare better.
    """
    answers = []
    for job in jobs:
        with contextlib.suppress(OSError):  # no Linux, or forbidden: the peak is then that of all jobs until now
            Path("/proc/self/clear_refs").write_text("5")
        cpu, read = time.process_time(), _own("io", "rchar")
        own = replace(options, camera=job.camera or options.camera, frames=job.frames or options.frames)
        try:
            found = as_row(check_recording(job.path, own)) if own.rig else check_source(job.path, own).result.to_dict()
            answer: Answer = {"result": found}
        except (MissingDependencyError, ImportError):
            raise
        except CalibrationError as error:
            answer = {"error": str(error), "from": INPUT}
            if job.fingerprint and not Path(split_scene(job.path)[0]).exists():
                nowhere = f"{job.path} is not there on {socket.gethostname()}; mount it on all workers"
                answer = {"error": nowhere, "from": OTHER}
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())}", "from": OTHER}
        used = {"bytes_read": _own("io", "rchar") - read, "peak_bytes": 1024 * _own("status", "VmHWM")}
        answers.append({**answer, "cpu_s": round(time.process_time() - cpu, 3), **used})
    return answers


def lost(jobs: Sequence[Recording], how: str) -> list[Answer]:
    """Answers of recordings whose workers ended."""
    advice = "out of memory? use fewer --workers, or give them more"
    return [{"error": f"the check of {job.path} did not end: {how}; {advice}", "from": OTHER} for job in jobs]


def _own(file: str, name: str) -> int:
    """What Linux tells of this process; "rchar" is read from files and pipes, be they in memory or not."""
    try:
        fields = dict(line.split(":", 1) for line in Path("/proc/self", file).read_text().splitlines())
        return int(fields[name].split()[0])
    except (OSError, KeyError, ValueError):  # no Linux, or hidden in a container
        return 0


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
    asked = options.options
    settings = options_key(asked)
    if options.certified is None:
        found, what = find_recordings(options.sources, options.vehicle_pattern), "fleet check"
    else:
        found, what = find_claims(options.sources, asked, options.certified), "certification"
    jobs = [replace(one, options=settings) for one in found]
    with Journal(options.out, ABOUT, options.fresh, what) as journal:
        # What failed for another reason than the recording may succeed now.
        for key in [key for key, answer in journal.done.items() if answer.get("from") == OTHER]:
            del journal.done[key]
        # With absolute paths, since workers may have started elsewhere.
        files = {"rig": asked.rig, "extrinsic": "" if asked.extrinsic in (REFERENCE, TF) else asked.extrinsic}
        absolute: dict[str, Any] = {name: str(Path(file).expanduser().resolve()) for name, file in files.items() if file}
        work, workers = partial(run_checks, replace(asked, **absolute)), options.workers or os.cpu_count() or 1
        run([[job] for job in jobs], work, journal, progress, workers, options.scheduler, lost)
        return [row_of(job, journal.done[job.key]) for job in jobs], list(journal.notes)

"""`calib-ros check` of several recordings, or of a folder of them, and `calib-ros certify`."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calib_ros.cli.inputs import configuration
from calib_ros.cli.output import note, progress_bar
from calib_ros.datasets.positions import selected
from calib_ros.errors import BadInputError
from calib_ros.result import VERSION
from calib_ros_check.fleet.check import check_fleet
from calib_ros_check.fleet.fleet import Fleet, FleetOptions
from calib_ros_check.fleet.history import ERROR
from calib_ros_check.fleet.page import change_size
from calib_ros_check.outcome import Tolerance
from calib_ros_check.recording import CheckOptions

SHOWN = 20  # changes, and errors, that are printed; all are in the tables


def check_many(args: argparse.Namespace, options: CheckOptions) -> int:
    """Check a fleet and say what was found; returns the exit code, see `Fleet.exit_code`."""
    for option in ("json", "report"):
        if getattr(args, option) is not None:
            raise BadInputError(f"--{option} is for one recording; the page and the tables of a fleet are written into --out")
    if args.frames:
        selected(args.frames)
    return _checked(args, options, "checking", vehicle_pattern=args.vehicle_pattern, false_alarms=args.false_alarms)


def certify_many(args: argparse.Namespace) -> int:
    """Certify and say what was found; returns the exit code, see `Fleet.exit_code`."""
    tolerance = Tolerance(args.tolerance_deg, args.tolerance_m)
    options = CheckOptions(tolerance=tolerance, camera=args.camera, config=configuration(args.config))
    return _checked(args, options, "certifying", certified=args.frames)


def _checked(args: argparse.Namespace, options: CheckOptions, doing: str, **more: Any) -> int:
    if not args.out:
        raise BadInputError("--out is given without a name; name a folder, or leave --out out")
    more |= {"workers": args.workers, "scheduler": args.scheduler or "", "fresh": args.fresh}
    asked = FleetOptions(args.source, Path(args.out), options, **more)
    command = shlex.join(["calib-ros", *args.given]).encode("utf-8", "replace").decode()
    facts = {"Command": command, "Version": f"calib-ros {VERSION}"}
    with progress_bar(doing) as step:
        fleet = check_fleet(asked, facts, lambda done, total: step(done, max(total, 1)))
    for line in fleet.notes:
        note(line)
    print(summary(fleet))
    return fleet.exit_code


def summary(fleet: Fleet) -> str:
    """What is printed: counts, what wants attention, files."""
    counts = ", ".join(f"{count} {verdict}" for verdict, count in fleet.counts.items())
    if fleet.certificates:
        doubtful = [f"{own.verdict}: {own.vehicle.name}: {own.reason}" for own in fleet.certificates if own.verdict != "pass"]
        lines = [f"{len(fleet.certificates)} calibrations: {counts}", *_first(doubtful, "")]
    else:
        changes = [
            f"{change.vehicle} changed between {change.before.recording} ({change.before.time}) and "
            f"{change.after.recording} ({change.after.time}) by {change_size(change)}"
            f"{'' if change.confirmed else ' (not confirmed, only the newest recording shows it)'}"
            for change in fleet.changes
        ]
        errors = [f"error: {row.vehicle}/{row.recording}: {row.message}" for row in fleet.rows if row.verdict == ERROR]
        lines = [f"{len(fleet.rows)} recordings of {len(fleet.vehicles)} vehicles: {counts}"]
        lines += [*_first(changes, " changes"), *_first(errors, " errors")]
    return "\n".join([*lines, *map(str, fleet.files)])


def _first(lines: Sequence[str], what: str) -> list[str]:
    more = len(lines) - SHOWN
    rest = [f"and {more} more{what}, see the table{'s' if what else ''}"] if more > 0 else []
    return [f"  {line}" for line in [*lines[:SHOWN], *rest]]

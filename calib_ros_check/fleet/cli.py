"""`calib-ros check` of several recordings, or of a folder of them."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from calib_ros.cli.output import note, progress_bar
from calib_ros.datasets.positions import check_positions
from calib_ros.errors import BadInputError
from calib_ros.result import VERSION
from calib_ros_check.fleet.fleet import Fleet, FleetOptions, check_fleet
from calib_ros_check.fleet.page import change_size
from calib_ros_check.fleet.rows import ERROR
from calib_ros_check.recording import CheckOptions

SHOWN = 20  # changes, and errors, that are printed; all are in the tables


def check_many(args: argparse.Namespace, options: CheckOptions) -> int:
    """Check a fleet and say what was found; returns the exit code, see `Fleet.exit_code`."""
    for option in ("json", "report"):
        if getattr(args, option) is not None:
            raise BadInputError(f"--{option} is for one recording; the page and the tables of a fleet are written into --out")
    if args.frames:
        check_positions(args.frames)
    facts = checked_arguments(args)
    fleet_options = FleetOptions(
        args.source,
        Path(args.out),
        options,
        args.vehicle_pattern,
        args.false_alarms,
        args.workers,
        args.scheduler or "",
        args.fresh,
    )
    with progress_bar("checking") as step:
        fleet = check_fleet(fleet_options, facts, lambda done, total: step(done, max(total, 1)))
    for line in fleet.notes:
        note(line)
    print(summary(fleet))
    return fleet.exit_code


def checked_arguments(args: argparse.Namespace) -> dict[str, str]:
    """Facts for the head of a page. BadInputError for --out without a name."""
    if not args.out:
        raise BadInputError("--out is given without a name; name a folder, or leave --out out")
    command = shlex.join(["calib-ros", *args.given]).encode("utf-8", "replace").decode()
    return {"Command": command, "Version": f"calib-ros {VERSION}"}


def summary(fleet: Fleet) -> str:
    """What is printed: counts, changes, errors, files."""
    counts = ", ".join(f"{count} {verdict}" for verdict, count in fleet.counts.items())
    lines = [f"{len(fleet.rows)} recordings of {len(fleet.vehicles)} vehicles: {counts}"]
    for change in fleet.changes[:SHOWN]:
        doubt = "" if change.confirmed else " (not confirmed, only the newest recording shows it)"
        lines.append(
            f"  {change.vehicle} changed between {change.before.recording} ({change.before.time}) and "
            f"{change.after.recording} ({change.after.time}) by {change_size(change)}{doubt}"
        )
    lines += _more(len(fleet.changes), "changes")
    errors = [row for row in fleet.rows if row.verdict == ERROR]
    lines += [f"  error: {row.vehicle}/{row.recording}: {row.message}" for row in errors[:SHOWN]] + _more(len(errors), "errors")
    return "\n".join([*lines, *(str(path) for path in fleet.files)])


def _more(count: int, what: str) -> list[str]:
    return [f"  and {count - SHOWN} more {what}, see the tables"] if count > SHOWN else []

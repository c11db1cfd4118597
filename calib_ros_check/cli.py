"""`calib-ros check`, of one recording or a fleet, and `calib-ros certify`."""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

from calib_ros.cli.inputs import configuration
from calib_ros.cli.output import again, check_json, first_lines, more_frames, note, print_or_save, progress_bar
from calib_ros.datasets.folder import is_folder_rig
from calib_ros.datasets.source import selected
from calib_ros.errors import BadInputError
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.result import VERSION, Cause
from calib_ros.rig.description import read_rig
from calib_ros_check.fleet.check import check_fleet
from calib_ros_check.fleet.fleet import Fleet, FleetOptions
from calib_ros_check.fleet.history import ERROR
from calib_ros_check.fleet.page import change_size
from calib_ros_check.fleet.recordings import is_fleet
from calib_ros_check.outcome import CauseState, CheckResult, CheckVerdict, Tolerance
from calib_ros_check.recording import TF, Checked, CheckOptions, check_source
from calib_ros_check.report import check_report, write_report, write_rig_check
from calib_ros_check.rig.check import RigCheck, check_recording

EXIT = {CheckVerdict.PASS: 0, CheckVerdict.FAIL: 1, CheckVerdict.INCONCLUSIVE: 3}
SHOWN = 20  # changes, and errors, that are printed; all are in the tables


def options_of(args: argparse.Namespace) -> CheckOptions:
    """How to check, as given on the command line. BadInputError for a tolerance out of range."""
    if args.overlay is not None:
        raise BadInputError(f"--overlay {args.overlay} is of calibrate: check has its pictures on a page, by --report HTML")
    as_given = ("extrinsic", "camera", "image_topic", "points_topic", "camera_info_topic", "clock", "incomplete", "rectified")
    given = {name: getattr(args, name) for name in as_given} | {"frames": args.frames or "", "rig": args.rig or ""}
    return CheckOptions(**given, config=configuration(args.config), tolerance=Tolerance(args.tolerance_deg, args.tolerance_m))


def is_one(sources: Sequence[str], rig: str | None) -> bool:
    """Whether sources are one recording, if of the rig that a file describes also as folders of its cameras."""
    if not is_fleet(sources):
        return True
    return rig is not None and len(sources) == 1 and is_folder_rig(Path(sources[0]).expanduser(), read_rig(rig))


def check_one(args: argparse.Namespace) -> int:
    """Check one recording, of a pair or a rig, and say what was found; returns the exit code."""
    options = options_of(args)
    if args.report is not None:
        check_report(args.report)
    check_json(args.json)
    found: CheckResult | RigCheck
    write: Callable[[str], None]
    told = [("", 0.0)]  # stages at each of their reports, and the CPU time of the process, s

    def stage(name: str, share: float, step: Callable[[float], None]) -> None:
        told.append((name, time.process_time()))
        step(share)

    if args.rig is None:
        with progress_bar("reading ") as reading, progress_bar("checking") as step:
            read, doing = partial(stage, "reading", step=reading), partial(stage, step=step)
            checked = check_source(args.source[0], options, read, doing, note)
        text = summary(checked, next_command(args, checked))
        found, write = checked.result, partial(write_report, checked=checked)
    else:
        with progress_bar("checking") as step:
            found = check_recording(args.source[0], options, partial(stage, step=step))
        text, write = rig_summary(found), partial(write_rig_check, found=found, config=options.config)
    if args.verbose:
        runs = [(name, list(own)) for name, own in groupby(pairwise(told), key=lambda own: own[1][0])]
        text += "\n  CPU: " + ", ".join(f"{name} {(own[-1][1][1] - own[0][0][1]) / told[-1][1]:.0%}" for name, own in runs)
    print_or_save(found, text, args.json)
    if args.report is not None:
        write(args.report)
    return EXIT[found.verdict]


def next_command(args: argparse.Namespace, checked: Checked) -> tuple[str, str]:
    """By which what is wrong is mended, or more is found out, see `again`; empty where none does."""
    result, cause, given = checked.result, checked.result.cause, args.given
    if result.verdict is not CheckVerdict.FAIL:
        more = more_frames(max(len(checked.frames), checked.made), checked.in_all) * (result.verdict is CheckVerdict.INCONCLUSIVE)
        # An estimate by all frames tells more, where a check by those it was made from would not.
        return again(
            given, *((f"--initial {shlex.quote(args.extrinsic)} {more}", "calibrate") if more and checked.made else (more,))
        )
    if cause is Cause.NOT_RECTIFIED and checked.frames[0].camera.said_rectified:
        return again(given, "--no-rectified")
    if cause is Cause.ALREADY_RECTIFIED or (cause is not None and not cause.options):
        return again(given, cause.options, "" if cause.options else "view")
    far, named = result.rotation.error > SearchBox.MAX_DEG, shlex.quote(args.extrinsic)
    start = "nominal" if far else "reference" if args.extrinsic == TF else named
    seconds = next((own.values["seconds"] for own in result.causes if own.cause is cause and "seconds" in own.values), 0.0)
    options = "" if cause is None else cause.options.format(seconds=checked.config.motion.time_offset_s + seconds)
    return again(given, f"--initial {start} {options}".strip(), "calibrate")


def summary(checked: Checked, command: tuple[str, str] = ("", "")) -> str:
    """What `calib-ros check` prints. command: of `again`."""
    result = checked.result
    lines = first_lines(result.verdict.value, result.reason, command)
    lines += [f"{axis.name}  {axis.verdict.value:<12}  {axis.words}" for axis in result.axes]
    untold = [own for own in result.causes if own.state is CauseState.NOT_JUDGED and result.T_estimated is not None]
    for message in dict.fromkeys(own.message for own in untold):
        names = ", ".join(own.cause.value for own in untold if own.message == message)
        lines.append(f"{names}: not judged, {message}")
    lines += [*result.notes, f"{result.frames_used} of {len(result.frame_names)} frames, {result.cpu_s:.1f} s of CPU"]
    return "\n  ".join(lines)


def rig_summary(found: RigCheck) -> str:
    """What it prints of a rig: the verdict, sensors, pairs, loops, notes."""
    rows = [(name, own.verdict.value, own.reason) for name, own in found.sensors.items()]
    rows += [(f"{pair.target} with {pair.source}", pair.verdict.value, pair.reason) for pair in found.pairs]
    for loop in found.solution.loops:
        size = f"{loop.size[0]:.2f} deg, {100 * loop.size[1]:.1f} cm"
        rows.append((f"loop {', '.join(loop.sensors)}", "closes" if loop.closes else "open", size))
    width = max(len(row[0]) for row in rows)
    lines = [f"  {name:<{width}}  {verdict:<12}  {reason}" for name, verdict, reason in rows]
    return "\n".join([f"{found.verdict.value}: {found.reason}", *lines, *(f"  {note}" for note in found.notes)])


def check_many(args: argparse.Namespace) -> int:
    """Check a fleet and say what was found; returns the exit code, see `Fleet.exit_code`."""
    for option in ("json", "report", "verbose"):
        if getattr(args, option) not in (None, False):
            raise BadInputError(f"--{option} is for one recording; the page and the tables of a fleet are written into --out")
    if args.frames:
        selected(args.frames)
    return _checked(args, options_of(args), "checking", vehicle_pattern=args.vehicle_pattern, false_alarms=args.false_alarms)


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
    print(fleet_summary(fleet))
    return fleet.exit_code


def fleet_summary(fleet: Fleet) -> str:
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
    rest = [f"and {len(lines) - SHOWN} more{what}, see the table{'s' if what else ''}"] if len(lines) > SHOWN else []
    return [f"  {line}" for line in [*lines[:SHOWN], *rest]]

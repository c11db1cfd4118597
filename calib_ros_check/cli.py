"""`calib-ros check`: is the extrinsic of a recording right?"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from calib_ros.cli.inputs import configuration
from calib_ros.cli.output import check_json, note, print_or_save, progress_bar
from calib_ros.datasets.rig import is_folder_rig
from calib_ros.rig.description import read_rig
from calib_ros_check.fleet.recordings import is_fleet
from calib_ros_check.outcome import CauseState, CheckResult, CheckVerdict, Tolerance
from calib_ros_check.recording import Checked, CheckOptions, check_source
from calib_ros_check.report import check_report, write_report, write_rig_check
from calib_ros_check.rig.check import RigCheck, check_recording

Found = tuple[CheckResult | RigCheck, str, Callable[[str], None]]  # with what is printed, and what writes its page
EXIT = {CheckVerdict.PASS: 0, CheckVerdict.FAIL: 1, CheckVerdict.INCONCLUSIVE: 3}


def options_of(args: argparse.Namespace) -> CheckOptions:
    """How to check, as given on the command line. BadInputError for a tolerance out of range."""
    as_given = ("extrinsic", "camera", "image_topic", "points_topic", "camera_info_topic", "clock", "incomplete", "rectified")
    options = CheckOptions(**{name: getattr(args, name) for name in as_given}, config=configuration(args.config))
    tolerance = Tolerance(args.tolerance_deg, args.tolerance_m)
    return replace(options, tolerance=tolerance, frames=args.frames or "", rig=args.rig or "")


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
    found, text, write = (_pair if args.rig is None else _rig)(args.source[0], options)
    print_or_save(found, text, args.json)
    if args.report is not None:
        write(args.report)
    return EXIT[found.verdict]


def _pair(source: str, options: CheckOptions) -> Found:
    with progress_bar("reading ") as reading, progress_bar("checking") as step:
        checked = check_source(source, options, reading, lambda stage, share: step(share), note)
    return checked.result, summary(checked), partial(write_report, checked=checked)


def _rig(source: str, options: CheckOptions) -> Found:
    with progress_bar("checking") as step:
        found = check_recording(source, options, lambda text, share: step(share))
    return found, rig_summary(found), partial(write_rig_check, found=found, config=options.config)


def summary(checked: Checked) -> str:
    """What `calib-ros check` prints."""
    result = checked.result
    lines = [f"{result.verdict.value}: {result.reason}"]
    lines += [f"  {axis.name}  {axis.verdict.value:<12}  {axis.words}" for axis in result.axes]
    # What the frames do not tell. A cause that was found is the reason of the verdict.
    untold = [own for own in result.causes if own.state is CauseState.NOT_JUDGED and result.T_estimated is not None]
    lines += [f"  {finding.cause.value}: {finding.message}" for finding in untold]
    lines += [f"  {line}" for line in result.notes]
    lines.append(f"  {result.frames_used} of {len(result.frame_names)} frames, {result.cpu_s:.1f} s of CPU")
    return "\n".join(lines)


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

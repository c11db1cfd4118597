"""`calib-ros check`: is the extrinsic of a recording right?"""

from __future__ import annotations

import argparse

from calib_ros.cli.inputs import configuration
from calib_ros.cli.output import check_json, note, print_or_save, progress_bar
from calib_ros_check.outcome import CauseState, CheckVerdict, Tolerance
from calib_ros_check.recording import Checked, CheckOptions, check_source

EXIT = {CheckVerdict.PASS: 0, CheckVerdict.FAIL: 1, CheckVerdict.INCONCLUSIVE: 3}


def options_of(args: argparse.Namespace) -> CheckOptions:
    """How to check, as given on the command line. BadInputError for a tolerance out of range."""
    return CheckOptions(
        args.extrinsic,
        Tolerance(args.tolerance_deg, args.tolerance_m),
        args.frames or "",
        args.camera,
        args.image_topic,
        args.points_topic,
        args.camera_info_topic,
        args.clock,
        args.incomplete,
        configuration(args.config),
        args.rig or "",
        args.rectified,
    )


def check_one(source: str, args: argparse.Namespace) -> int:
    """Check one recording and say what was found; returns the exit code."""
    options = options_of(args)
    if args.report is not None:
        from calib_ros_check.report import check_report

        check_report(args.report)
    check_json(args.json)
    with progress_bar("reading ") as reading, progress_bar("checking") as step:
        checked = check_source(source, options, reading, lambda stage, share: step(share), note)
    result = checked.result
    print_or_save(result, summary(checked), args.json)
    if args.report is not None:
        from calib_ros_check.report import write_report

        write_report(args.report, result, checked.frames, checked.source, checked.config)
    return EXIT[result.verdict]


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

"""`calib-ros check --rig`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from calib_ros.cli.output import check_json, print_or_save, progress_bar
from calib_ros.datasets.rig import is_folder_rig
from calib_ros.rig.description import read_rig
from calib_ros_check.cli import EXIT, options_of
from calib_ros_check.fleet.recordings import is_fleet
from calib_ros_check.rig.check import RigCheck, check_recording


def is_one_rig(sources: Sequence[str], rig: str) -> bool:
    """Whether sources are one recording of the rig that a file describes, though it be folders of its cameras."""
    return not is_fleet(sources) or (len(sources) == 1 and is_folder_rig(Path(sources[0]).expanduser(), read_rig(rig)))


def check_one_rig(args: argparse.Namespace) -> int:
    """Check a rig by its recording and say what was found; returns the exit code."""
    options = options_of(args)
    if args.report is not None:
        from calib_ros_check.report import check_report

        check_report(args.report)
    check_json(args.json)
    with progress_bar("checking") as step:
        found = check_recording(args.source[0], options, lambda text, share: step(share))
    print_or_save(found, summary(found), args.json)
    if args.report is not None:
        from calib_ros_check.rig.page import write_rig_page

        write_rig_page(args.report, found, options.config)
    return EXIT[found.verdict]


def summary(found: RigCheck) -> str:
    """What is printed: the verdict, sensors, pairs, loops, notes."""
    rows = [(name, own.verdict.value, own.reason) for name, own in found.sensors.items()]
    rows += [(f"{pair.target} with {pair.source}", pair.verdict.value, pair.reason) for pair in found.pairs]
    for loop in found.solution.loops:
        size = f"{loop.size[0]:.2f} deg, {100 * loop.size[1]:.1f} cm"
        rows.append((f"loop {', '.join(loop.sensors)}", "closes" if loop.closes else "open", size))
    width = max(len(row[0]) for row in rows)
    lines = [f"  {name:<{width}}  {verdict:<12}  {reason}" for name, verdict, reason in rows]
    return "\n".join([f"{found.verdict.value}: {found.reason}", *lines, *(f"  {note}" for note in found.notes)])

"""`calib-ros rig`."""

from __future__ import annotations

import argparse
import sys

from calib_ros.cli.inputs import configuration
from calib_ros.cli.output import check_json, print_or_save, progress_bar
from calib_ros.datasets.rig import open_rig
from calib_ros.errors import BadInputError
from calib_ros.io import check_output, write_atomically
from calib_ros.rig.description import read_rig
from calib_ros.rig.edges import RigMeasurer
from calib_ros.rig.report import RigReport, check_out, load


def run(args: argparse.Namespace) -> bool:
    """Estimate a rig from its recording, and write what is asked for; whether all sensors converged."""
    description = read_rig(args.rig)
    before = None if args.before is None else load(args.before)
    if before is not None and set(before.poses) != {sensor.name for sensor in description.sensors}:
        names = ", ".join(before.poses)
        raise BadInputError(f"--before {args.before} is of other sensors ({names}) than {args.rig}; give a result of this rig")
    config = configuration(args.config, args.seed)
    check_json(args.json)
    if args.report is not None:
        check_output(args.report, "--report")
    for path in args.out:
        check_out(path)
        check_output(path, "--out")
    rig = open_rig(args.source, description)
    with progress_bar("measuring") as step:
        measurer = RigMeasurer(rig, description, config, args.frames, lambda text, share: step(share))
        measured = measurer.measure()
    report = RigReport.of(measurer, measured, before)
    print_or_save(report, report.text(), args.json)
    if args.report is not None:
        write_atomically(args.report, report.html().encode())
    for path in args.out:
        if remark := report.write(path):
            print(f"calib-ros: {remark}", file=sys.stderr)
    return report.converged

"""`calib-ros certify`: is every calibration of a data set right?"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from calib_ros.cli.inputs import configuration
from calib_ros.cli.output import note, progress_bar
from calib_ros.errors import BadInputError
from calib_ros_check.certify.certificates import Certified
from calib_ros_check.certify.certify import certify
from calib_ros_check.fleet.cli import SHOWN, checked_arguments
from calib_ros_check.fleet.fleet import FleetOptions
from calib_ros_check.fleet.rows import VERDICTS
from calib_ros_check.outcome import Tolerance
from calib_ros_check.recording import CheckOptions


def certify_many(args: argparse.Namespace) -> int:
    """Certify and say what was found; returns the exit code, see `Certified.exit_code`."""
    facts = checked_arguments(args)
    tolerance = Tolerance(args.tolerance_deg, args.tolerance_m)
    if args.frames < 1:
        raise BadInputError(f"--frames {args.frames}: give at least 1")
    checks = CheckOptions(tolerance=tolerance, camera=args.camera, config=configuration(args.config))
    options = FleetOptions(
        args.source, Path(args.out), checks, workers=args.workers, scheduler=args.scheduler or "", fresh=args.fresh
    )
    with progress_bar("certifying") as step:
        certified = certify(options, args.frames, facts, lambda done, total: step(done, max(total, 1)))
    for line in certified.notes:
        note(line)
    print(summary(certified))
    return certified.exit_code


def summary(certified: Certified) -> str:
    """What is printed: counts, the doubtful, files."""
    own = certified.certificates
    counted = Counter(one.verdict for one in own)
    lines = [f"{len(own)} calibrations: {', '.join(f'{counted[verdict]} {verdict}' for verdict in VERDICTS)}"]
    doubtful = [one for one in own if one.verdict != "pass"]
    lines += [f"  {one.verdict}: {one.name}: {one.reason}" for one in doubtful[:SHOWN]]
    lines += [f"  and {len(doubtful) - SHOWN} more, see the table"] if len(doubtful) > SHOWN else []
    return "\n".join([*lines, *map(str, certified.files)])

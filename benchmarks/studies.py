"""Studies of one shape: sources x variants x trials -> a record each -> a table.

    python -m benchmarks.studies NAME [SOURCE ...] [--kitti FOLDER] [--trials N] [--cases N] [--variants NAME ...] [--csv FILE]
        [--workers N] [--config YAML]

registration  the table by which every change is judged: success and accuracy over random starts, on KITTI (--kitti) and a
              synthetic drive; SOURCE: names of its rows
vehicles      is what is accepted right, and what is right accepted: single frames and sets of SOURCE, of --soft, whose reference
              is known to 0.9 deg / 25 cm only, and of the synthetic --rigs
chance        images with scans of another place, and mirrored ones: are they accepted as rarely as p values say? SOURCE, --rigs
covariance    normalised errors squared of estimates from subsets of frames of SOURCE, or synthetic drives and KITTI
intrinsics    are right intrinsics ever refused, and wrong ones ever accepted: single frames and sets of SOURCE, or all rigs
monitor_hours hours of quiet driving and knocks, driving and standing: SOURCE of 10 Hz, or six synthetic rigs, lap after lap

--trials: starts of a case, or how many drives. The same command goes on with a study that was interrupted where its --csv ends.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import cv2

from benchmarks import study_acceptance, study_hours, study_intrinsics, study_registration
from benchmarks.records import append_records, read_records
from benchmarks.study_registration import SCENES
from benchmarks.study_runner import Record, Study, run
from calib_ros.errors import CalibrationError

STUDIES: dict[str, Study] = {
    **study_registration.STUDIES,
    "chance": study_acceptance.STUDY,
    "intrinsics": study_intrinsics.STUDY,
    "monitor_hours": study_hours.STUDY,
}


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", choices=list(STUDIES))
    parser.add_argument("sources", nargs="*", help="as for calib-ros")
    parser.add_argument("--soft", nargs="*", default=[], help="more sources, whose reference is less exact")
    parser.add_argument("--rigs", nargs="*", choices=SCENES, metavar="SCENE", help="the synthetic rigs, in these scenes or all")
    parser.add_argument("--kitti", type=Path, help="folder of the KITTI recordings")
    parser.add_argument("--trials", type=int)
    parser.add_argument("--cases", type=int, help="only so many of the first")
    parser.add_argument("--variants", nargs="+", metavar="NAME")
    parser.add_argument("--config", help="YAML")
    parser.add_argument("--csv", type=Path, help="add every trial; go on with a study that was interrupted")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, metavar="N", help="processes (default one per core)")
    args = parser.parse_args()
    study = STUDIES[args.study]
    if unknown := set(args.variants or ()) - set(study.variants):
        parser.error(f"no variant {', '.join(sorted(unknown))}; there are {', '.join(study.variants)}")
    cv2.setNumThreads(1)  # before any work: a forked worker would wait for ever for threads that only its parent has
    records = read_records(args.csv, Record)
    try:
        for record in run(study, args, records):
            records.append(record)
            append_records(args.csv, [record])
    except CalibrationError as error:
        parser.error(str(error))
    print(study.table(records))
    return 0


if __name__ == "__main__":
    sys.exit(main())

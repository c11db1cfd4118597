"""Is it found out how a driver without point times stamps its scans? Synthetic drives of several rigs, each with a convention.

    python -m benchmarks.stamping_study [--drives 40] [--frames 8]

Weaving drives of spinning rigs in turn, seed after seed; the head turns either way, stamps are those of the start, the middle or
the end of a scan, all by chance. Clouds have no times. Every run searches 5 deg / 0.5 m around a start up to 2 deg / 0.2 m per
axis beside the extrinsic, without classes. A line per drive, and the share in which the stamped part of the scan was named
rightly, and in which the direction of turn was.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.contract_study import CLASSES_OFF
from benchmarks.time_offset_study import BOX, start_of
from calib_ros import se3
from calib_ros.config import Config, update
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.nuisance.stamping import convention
from calib_ros.result import Stamping
from calib_ros_synthetic.drive import SyntheticDrive

RIGS = ("vlp32c_roof", "os1_128_windshield", "hdl64e_kitti", "pandar64_roof", "os1_64_robot", "vls128_wide", "os1_64_wide")


def main() -> int:
    """Measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=40)
    parser.add_argument("--frames", type=int, default=8, help="of each drive (default 8)")
    args = parser.parse_args()
    config, right = update(Config(), CLASSES_OFF), {"stamp": 0, "spin": 0, "accepted": 0}
    for number in range(args.drives):
        rng = np.random.default_rng([number, 20])
        rig, stamp_at, spin = RIGS[number % len(RIGS)], rng.choice(["start", "middle", "end"]), rng.choice([0, 1])
        true_spin = ("clockwise", "counterclockwise")[spin]
        facts: dict[str, Any] = {"rig": rig, "ride": "weaving", "stamp_at": str(stamp_at), "spin": true_spin}
        drive = SyntheticDrive(number, args.frames, **facts)
        frames = [drive[k] for k in range(args.frames)]
        frames = [replace(f, cloud=replace(f.cloud, time=None)) for f in frames]
        calibrator = Calibrator(drive.camera, config)
        result = calibrator.estimate([calibrator.extract(f) for f in frames], start_of(drive.reference, number), BOX)
        found, left = convention(result.stamping or Stamping("clockwise", 0.0), result.time_offset_s or 0.0, 0.1)
        right["stamp"] += result.converged and found.stamp_at == stamp_at
        right["spin"] += result.converged and found.spin == true_spin
        right["accepted"] += result.converged
        error = se3.rotation_error_deg(drive.reference, result.T_camera_lidar)
        cm = 100 * se3.translation_error_m(drive.reference, result.T_camera_lidar)
        print(
            f"{number:2d} {rig:20s} {true_spin} {stamp_at}: {result.status}, {found.spin} {found.stamp_at}, "
            f"{1000 * left:+.1f} ms left, {error:.2f} deg {cm:.1f} cm",
            flush=True,
        )
    print(", ".join(f"{name}: {count} of {args.drives}" for name, count in right.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())

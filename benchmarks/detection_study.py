"""Is a miscalibration told from a right extrinsic? Published perturbations of KITTI odometry 00, frame by frame.

    python -m benchmarks.detection_study KITTI_ODOMETRY_00 TABLE.csv [--frames 1] [--tolerance-deg 1 --tolerance-m 0.05]

TABLE.csv has the columns set, frame, x_m, y_m, z_m, rx_deg, ry_deg, rz_deg; the extrinsic T_camera_lidar is checked as
T_camera_lidar D, with D of the rotation vector times `doubled` and the shift. Set "pos" holds right extrinsics, all others wrong
ones. With more frames per decision the following ones of the source are added, under the same perturbation.
"""

from __future__ import annotations

import argparse
import csv
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros import open_dataset, se3
from calib_ros.check.checker import Checker
from calib_ros.check.outcome import Tolerance, Verdict

RIGHT = "pos"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("table", type=Path)
    parser.add_argument("--frames", type=int, default=1)
    parser.add_argument("--doubled", type=float, default=2.0)
    parser.add_argument("--tolerance-deg", type=float, default=1.0)
    parser.add_argument("--tolerance-m", type=float, default=0.05)
    args = parser.parse_args()
    source = open_dataset(args.source)
    frames = [source[k] for k in range(len(source))]
    checker, tolerance = Checker(source.camera), Tolerance(args.tolerance_deg, args.tolerance_m)
    said: dict[str, Counter[str]] = defaultdict(Counter)
    cpu = []
    with args.table.open() as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        first = next((k for k, frame in enumerate(frames) if row["frame"] in frame.name), None)
        if first is None:
            continue
        turn = args.doubled * np.deg2rad([float(row[name]) for name in ("rx_deg", "ry_deg", "rz_deg")])
        D = se3.from_parts(Rotation.from_rotvec(turn).as_matrix(), [float(row[name]) for name in ("x_m", "y_m", "z_m")])
        own = [frames[(first + k) % len(frames)] for k in range(min(args.frames, len(frames)))]
        truth = own[0].reference if own[0].reference is not None else source.reference
        assert truth is not None
        result = checker.check(own, truth @ D, tolerance)
        wanted = Verdict.PASS if row["set"] == RIGHT else Verdict.FAIL
        kind = "inconclusive" if result.verdict is Verdict.INCONCLUSIVE else "right" if result.verdict is wanted else "wrong"
        said[row["set"]][kind] += 1
        cpu.append(result.cpu_s)
        if kind != "right":
            size = f"{np.rad2deg(np.linalg.norm(turn)):.2f} deg, {100 * np.linalg.norm(D[:3, 3]):.1f} cm"
            print(f"{row['set']} {row['frame']} ({size}): {result.reason}", flush=True)
    print("| set | decisions | right | wrong | inconclusive |\n|---|---|---|---|---|")
    for name, counts in [*said.items(), ("all", sum(said.values(), Counter()))]:
        print(f"| {name} | {counts.total()} | {counts['right']} | {counts['wrong']} | {counts['inconclusive']} |")
    print(
        f"{args.frames} frames per decision, {tolerance.deg:g} deg / {100 * tolerance.m:g} cm; CPU {np.median(cpu):.1f} s median"
    )


if __name__ == "__main__":
    main()

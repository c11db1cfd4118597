"""Is a fleet checked rightly? Recordings of vehicles some of which change, with bad ones.

    python -m benchmarks.fleet_study FOLDER [--recordings 12] [--frames 10] [--workers 2]

Five synthetic vehicles are recorded into FOLDER, which is kept and reused. Of three, the scanner is moved before a known
recording, while /tf_static says what was right before. Told are the changes, the verdicts, the bad recordings, and what each
check cost.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.sources import Changed
from calib_ros import se3
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.source import Source
from calib_ros.frame import NANOSECONDS, Frame

Matrix = NDArray[np.float64]
SCENES = ("street", "car_park", "trees")
FIRST, APART = 1_760_000_000 * NANOSECONDS, 7 * 86_400 * NANOSECONDS  # of the recordings of a vehicle
BAD = ("truncated", "empty", "no_image", "garbage.mcap")


@dataclass(frozen=True)
class Vehicle:
    """rig: of the synthetic drive. width: of its pictures, px. step: what the extrinsic changes by, deg and m, in the camera's
    axes, before recording `first`; None = it stays."""

    name: str
    rig: str
    width: int
    step: tuple[float, ...] | None = None
    first: int = 0

    def change(self, T: Matrix) -> Matrix:
        """T_camera_lidar (4, 4) after the change."""
        if self.step is None:
            return T
        turn = se3.exp(np.r_[np.deg2rad(self.step[:3]), 0.0, 0.0, 0.0])
        return se3.from_parts(turn[:3, :3] @ T[:3, :3], T[:3, 3] + self.step[3:])


VEHICLES = (
    Vehicle("car_a", "vlp32c_roof", 640, (0.0, 0.6, 0.2, 0.0, 0.0, 0.0), 5),
    Vehicle("car_b", "hdl64e_kitti", 800, (0.0, 0.0, 0.0, 0.08, 0.0, 0.05), 8),
    Vehicle("car_c", "pandar64_roof", 640, (0.35, -0.2, 0.0, 0.0, 0.05, 0.0), 10),
    Vehicle("car_d", "hdl32e_front", 640),
    Vehicle("car_e", "os1_128_windshield", 640),
)


def recorded(drive: Source, T: Matrix, day: int) -> Changed:
    """A drive as it would be recorded on a day when the scanner sits elsewhere, as by T (4, 4); the reference stays that of the
    drive. day: number of the recording."""
    assert drive.reference is not None
    moved = se3.inverse(T) @ drive.reference
    later = FIRST + day * APART - drive[0].stamp

    def change(frame: Frame) -> Frame:
        xyz = se3.transform(moved, frame.cloud.xyz).astype(np.float32)
        cloud_stamp = None if frame.cloud_stamp is None else frame.cloud_stamp + later
        return replace(frame, cloud=replace(frame.cloud, xyz=xyz), stamp=frame.stamp + later, cloud_stamp=cloud_stamp, twist=None)

    return Changed(drive, change)


def record(folder: Path, recordings: int, frames: int) -> None:
    """Write what is missing of all recordings, and the bad ones."""
    for v, vehicle in enumerate(VEHICLES):
        for day in tqdm(range(recordings), desc=f"recording {vehicle.name}", disable=not sys.stderr.isatty()):
            path = folder / vehicle.name / f"drive_{day:02d}"
            if path.exists():
                continue
            text = f"rig={vehicle.rig},scene={SCENES[day % len(SCENES)]},seed={100 * v + day},width={vehicle.width}"
            drive = open_dataset(f"synthetic:{text},frames={frames},stride=4,tilt_deg=0")
            assert drive.reference is not None
            T = vehicle.change(drive.reference) if vehicle.step and day >= vehicle.first else drive.reference
            write_bag(recorded(drive, T, day), path)
    spoil(folder / VEHICLES[-1].name / "drive_00", folder / "broken")


def spoil(good: Path, folder: Path) -> None:
    """Recordings that nobody can read, made of a good one."""
    shutil.rmtree(folder, ignore_errors=True)
    (folder / BAD[1]).mkdir(parents=True)
    shutil.copytree(good, folder / BAD[0])
    file = folder / BAD[0] / f"{good.name}.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    shutil.copytree(good, folder / BAD[2])
    metadata = folder / BAD[2] / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("sensor_msgs/msg/Image\n", "sensor_msgs/msg/Imu\n"))
    (folder / BAD[3]).write_bytes(np.random.default_rng(0).bytes(100_000))


def read(path: Path) -> list[dict[str, str]]:
    """Lines of a table."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def report(out: Path, recordings: int) -> str:
    """What came of it, for people."""
    rows, changes = read(out / "fleet.csv"), read(out / "changes.csv")
    lines = ["changes"]
    wanted = {(own.name, f"drive_{own.first:02d}"): own.step for own in VEHICLES if own.step and own.first < recordings}
    for one in changes:
        step = wanted.pop((one["vehicle"], one["after"]), None)
        axes = ("rx_deg", "ry_deg", "rz_deg", "tx_m", "ty_m", "tz_m")
        found = " ".join(f"{float(one[axis]):+.3f}+-{float(one[f'{axis}_sigma']):.3f}" for axis in axes)
        lines.append(f"  {one['vehicle']} before {one['after']}: {found}; {'true ' + str(step) if step else 'FALSE'}")
    lines += [f"  MISSED {vehicle} before {after}: {step}" for (vehicle, after), step in wanted.items()]
    good = [row for row in rows if row["vehicle"] != "broken"]
    counted = Counter((row["verdict"], _is_wrong(row)) for row in good)
    lines += ["", "verdicts of recordings whose extrinsic is"]
    for name, wrong in (("within the tolerance", False), ("beyond it", True)):
        parts = [f"{n} {verdict}" for (verdict, is_wrong), n in sorted(counted.items()) if is_wrong is wrong]
        lines.append(f"  {name}: {', '.join(parts)}")
    lines += ["", "bad recordings"]
    lines += [f"  {row['recording']}: {row['verdict']}, {row['message'][:100]}" for row in rows if row["vehicle"] == "broken"]
    cost = [np.array([float(row[name]) for row in good]) for name in ("cpu_s", "bytes_read", "peak_bytes")]
    size = np.mean([sum(f.stat().st_size for f in Path(row["path"]).iterdir()) for row in good])
    lines += [
        "",
        f"cost of a recording, median and highest: {np.median(cost[0]):.1f} and {cost[0].max():.1f} s of CPU, "
        f"{np.median(cost[1]) / 1e6:.0f} and {cost[1].max() / 1e6:.0f} MB read of {size / 1e6:.0f} MB, "
        f"{np.median(cost[2]) / 1e6:.0f} and {cost[2].max() / 1e6:.0f} MB of memory",
    ]
    return "\n".join(lines)


def _is_wrong(row: dict[str, str]) -> bool:
    """Whether the true error of what /tf_static says exceeds the tolerance."""
    vehicle = next(own for own in VEHICLES if own.name == row["vehicle"])
    if vehicle.step is None or int(row["recording"][-2:]) < vehicle.first:
        return False
    return bool(np.linalg.norm(vehicle.step[:3]) > 0.5 or np.linalg.norm(vehicle.step[3:]) > 0.1)


def main(argv: Sequence[str] | None = None) -> int:
    """Record, check, report."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("folder", type=Path)
    options.add_argument("--recordings", type=int, default=12)
    options.add_argument("--frames", type=int, default=10)
    options.add_argument("--workers", type=int, default=2)
    args = options.parse_args(argv)
    fleet, out = args.folder / "fleet", args.folder / "out"
    record(fleet, args.recordings, args.frames)
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, "-m", "calib_ros", "check", str(fleet), "--out", str(out), "--workers", str(args.workers)]
    started = time.monotonic()
    status = subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
    print(f"the check took {time.monotonic() - started:.0f} s and ended with {status}\n\n{report(out, args.recordings)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())

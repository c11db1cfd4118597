"""Replays a drive with events: drift, displaced mount, covered lens, lost clouds, late camera, empty road.

    python -m benchmarks.events_study [SOURCE] [--events default|none] [--out DIR] [--seconds 180]

SOURCE: a synthetic drive (by default one at 10 Hz; what its text leaves out is added), a recording, which is played there and
back until the time is full, or `kitti`: drive 0005 below $KITTI_ROOT. Each frame is processed as by `calib-ros replay`, and
estimates take no time of the drive. The start is the truth, turned by 1 deg and moved by 5 cm. Writes moments.csv and
moments.png, and prints how soon each event was noticed and dealt with, and how often a wrong extrinsic was called converged.
"""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path

import cv2
import numpy as np

from benchmarks.events import LOOKS, Covered, Event, EventSource, default_events
from benchmarks.events_recorded import ThereAndBack
from benchmarks.events_replay import plot, record, table, verdict, write_csv
from calib_ros import se3
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.online.recalibrator import Recalibrator
from calib_ros_synthetic.scanners import PERIOD

SYNTHETIC = {"seed": "11", "stride": "1", "width": "828", "height": "250", "rings": "64"}
OF_THE_RIG = ("width", "height", "rings")
DRIVE = "raw/2011_09_26/2011_09_26_drive_0005_sync"
START_DEG, START_M = 1.0, 0.05


def opened(text: str, seconds: float) -> Source:
    """The drive without events, `seconds` long."""
    if text.startswith("synthetic"):
        given = dict(re.findall(r"(\w+)\s*=\s*([^,\s]+)", text))
        # A rig has its own scanner and camera.
        values = {name: value for name, value in SYNTHETIC.items() if "rig" not in given or name not in OF_THE_RIG} | given
        values["frames"] = str(max(round(seconds / (int(values["stride"]) * PERIOD)), 1))
        return open_dataset("synthetic:" + ",".join(f"{k}={v}" for k, v in values.items()))
    if text == "kitti":
        if "KITTI_ROOT" not in os.environ:
            raise BadInputError("set KITTI_ROOT to the folder of the KITTI recordings, or give the path of a drive")
        text = str(Path(os.environ["KITTI_ROOT"]) / DRIVE)
    return ThereAndBack(open_dataset(text), seconds)


def chosen_events(text: str, synthetic: bool, look: str) -> list[Event]:
    """Of --events."""
    if text == "none":
        return []
    events = default_events(synthetic)
    return [Covered(e.start, e.end, look) if isinstance(e, Covered) else e for e in events]


def started(source: Source, seed: int) -> np.ndarray:
    """The extrinsic at the start of the drive, disturbed."""
    assert source.reference is not None
    rng = np.random.default_rng(seed)
    axis, direction = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    return se3.perturb(source.reference, START_DEG * axis, START_M * direction)


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default="synthetic", metavar="SOURCE")
    parser.add_argument("--events", choices=("default", "none"), default="default")
    parser.add_argument("--look", choices=LOOKS, default="dark", help="of the covered lens among the default events")
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--out", type=Path, default=Path("events_out"), metavar="DIR")
    parser.add_argument("--config", help="YAML")
    parser.add_argument("--seed", type=int, default=0, help="of the disturbed start")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        events = chosen_events(args.events, args.source.startswith("synthetic"), args.look)
        study(EventSource(opened(args.source, args.seconds), events), args)
    except BadInputError as error:
        parser.error(str(error))


def study(source: EventSource, args: argparse.Namespace) -> None:
    """Replay, write, print."""
    events = [e for e in source.events if e.start <= source.times[-1]]
    config = Config.from_yaml(args.config) if args.config else Config()
    start = started(source, args.seed)
    moments, used = record(source, Recalibrator(source.camera, start, config, source.camera_frame, source.lidar_frame))
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "moments.csv", moments)
    title = f"{args.source}, {moments[-1].time:.0f} s, start {START_DEG:g} deg / {100 * START_M:g} cm off (seed {args.seed})"
    plot(args.out / "moments.png", title, moments, events)
    print(table(moments, events))
    print(verdict(moments, events))
    estimates = sum(m.estimate for m in moments)
    print(f"{len(moments)} frames, {estimates} estimates, {used:.0f} s of CPU; {args.out}/moments.csv, moments.png")


if __name__ == "__main__":
    main()

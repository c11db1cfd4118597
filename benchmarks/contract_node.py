"""The faults of the study `contract` in a real node: a process of its own, fed over DDS, beside other work on its cores.

    python -m benchmarks.contract_node SOURCE [--faults NAME ...] [--runs 3] [--seconds 30] [--busy 1] [--csv FILE]

Publishers are plain rclpy ones; the node has its default configuration. --busy: so many processes compete for the cores. A line
per fault: the runs in which a message ever said `usable` or `converged` more than 0.5 deg or 10 cm off; the status at the end;
and the time from the first pair to the first verdict, as in that study.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from calib_ros_msgs.msg import Extrinsic
from numpy.typing import NDArray

from benchmarks.fed_node import fed_node, own_network
from benchmarks.records import append_records
from benchmarks.sources import Changed
from benchmarks.study_contract import FAULTS, Fault, Watch, beside, table
from benchmarks.study_runner import NEAR, Record
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.source import Source
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS
from calib_ros.result import MOVED, REFUSED
from calib_ros.ros.client import result_from_message

Matrix = NDArray[np.float64]
QUIET_S = 5.0  # after the last pair, for estimates under way


class Faulty(Changed):
    """A source with a fault."""

    def __init__(self, source: Source, fault: Fault) -> None:
        super().__init__(source, fault.changed)
        first, last = self[0], self[len(self) - 1]
        self.camera, self.reference = first.camera, first.reference
        self.rate = (len(self) - 1) * NANOSECONDS / (last.stamp - first.stamp)  # frames per second, of a source with stamps


@contextmanager
def competing(processes: int) -> Iterator[None]:
    """So many processes that never rest."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def play(name: str, source: Faulty, bag: Path, folder: Path, number: int, seconds: float) -> Record:
    """One run of a node."""
    fault, reference = FAULTS[name], source.reference
    assert reference is not None
    watch, began = Watch(fault), float("inf")

    def hear(msg: Any) -> None:
        T = result_from_message(msg).T_camera_lidar
        now = time.monotonic() - began if time.monotonic() > began else float("nan")
        watch.tell(T, reference, msg.status, bool(msg.usable), msg.status in (REFUSED, MOVED), now)

    with fed_node(bag, beside(reference, fault, number), folder) as fed:
        fed.client._node.create_subscription(Extrinsic, "/calib_ros/extrinsic", hear, 100)
        fed.client.spin(0.5)
        began = time.monotonic()
        fed.run(round(seconds * source.rate), source.rate)
        fed.client.spin(QUIET_S, fed.ended)
        fed.check()
    end = watch.end()
    right = end.deg < NEAR[0] and end.cm < NEAR[1]
    return Record(source.name, name, 0, number, right, end.deg, end.cm, end.status, float("nan"), end.said)


def measure(args: argparse.Namespace, scratch: Path) -> list[Record]:
    """All faults."""
    plain, runs = open_dataset(args.source), []
    if plain.reference is None:
        raise CalibrationError(f"{plain.name} states no reference extrinsic; give KITTI, or synthetic")
    with competing(args.busy):
        for name in args.faults:
            source = Faulty(plain, FAULTS[name])
            bag = write_bag(source, scratch / "bag")
            for number in range(args.runs):
                runs.append(play(name, source, bag, scratch, number, args.seconds))
                print(table(runs[-1:]), flush=True)
                append_records(args.csv, runs[-1:])
            bag.rename(scratch / f"bag_{len(runs)}")
    return runs


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="as for calib-ros, with stamps")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), choices=list(FAULTS), metavar="NAME")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=30.0, help="of data in each run (default 30)")
    parser.add_argument("--busy", type=int, default=1, help="processes that compete for the cores (default 1)")
    parser.add_argument("--csv", type=Path)
    args = parser.parse_args()
    if args.csv and args.csv.exists():
        parser.error(f"{args.csv} exists already; give another file")
    own_network()
    with tempfile.TemporaryDirectory() as scratch:
        try:
            runs = measure(args, Path(scratch))
        except CalibrationError as error:
            print(f"contract_node: {error}", file=sys.stderr)
            return 2
        finally:
            rclpy.try_shutdown()
    print(table(runs))
    return 1 if any(run.said.startswith("1") for run in runs) else 0


if __name__ == "__main__":
    sys.exit(main())

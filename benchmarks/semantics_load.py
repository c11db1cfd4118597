"""What models cost the node: one run of a real node over DDS, fed at 10 Hz, with one kind of model after the other.

    python -m benchmarks.semantics_load [SOURCE] [--seconds 70] [--threads 1] [--only camera scan] [--out FOLDER]

SOURCE: as for calib-ros; by default a synthetic drive of 60 frames. The models are stacks of convolutions with random weights, of
about the parameters and the operations of well-known networks; what they answer means nothing, but is as long to work off. A
phase is to last until the newest 2000 callbacks, of which the node tells the 99th percentile, are its own: 65 s.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from benchmarks.fed_node import DRIVE, OFF, RATE, Feeding, Pace, fed_node, on_recording
from benchmarks.semantics_models import camera, fast_sam, pair, scan
from calib_ros import se3


def builtin(folder: Path) -> tuple[dict[str, str], str]:
    """What the package brings."""
    return {"image_classes": "builtin", "cloud_classes": "geometric"}, "0.69 M, and points by shape"


FAMILIES = (builtin, pair, fast_sam, camera, scan)
HEAD = """\
| models | parameters, operations | seconds | keyframes a minute, with semantics | p99, ms | worker load | MB, at most |
|---|---|---|---|---|---|---|"""
KINDS = ("segment_anything", "segment_anything_decoder", "image_classes", "cloud_classes")


def memory_mb(pid: int, name: str) -> float:
    """VmRSS, or VmHWM: the most since it was forgotten."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(name)) / 1024


class Phases:
    """One kind of models after the other, in a node that is fed all the time; a row of the table for each."""

    def __init__(self, fed: Feeding, plans: Sequence[tuple[str, dict[str, str], str]], args: Any) -> None:
        self.fed, self.pid, self.plans, self.args = fed, fed.process.pid, plans, args
        self.values: dict[str, str] = {}
        self._parameters = AsyncParameterClient(fed.client._node, "/calib_ros")
        self._pairs, self._now, self._seen, self._done = 0, -1, 0, 0
        fed.client._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        self.values = {v.key: v.value for v in msg.status[0].values}

    @property
    def pairs(self) -> int:
        """Of one phase."""
        return int(self.args.seconds * RATE)

    def idle(self, due: float) -> None:
        """Before each pair: the next phase if it is time, then listen until the time has come."""
        if self._pairs % self.pairs == 0:
            self.finish()
            self._begin()
        self._pairs += 1
        self.fed.idle(due)

    def _begin(self) -> None:
        self._now += 1
        wanted = {**dict.fromkeys(KINDS, ""), "threads": self.args.threads, **self.plans[self._now][1]}
        self._parameters.set_parameters([Parameter(f"semantics.{k}", value=v) for k, v in wanted.items()])
        Path(f"/proc/{self.pid}/clear_refs").write_text("5")  # forgets what was the most
        self._seen, self._done = self._count("keyframes so far"), self._count("semantics")

    def _count(self, name: str) -> int:
        number = self.values.get(name, "").split(" ")[0]
        return int(number) if number.isdigit() else 0

    def finish(self) -> None:
        """The row of the phase that ends."""
        if self._now < 0:
            return
        (name, models, size), minutes = self.plans[self._now], self.args.seconds / 60
        took = self.values["semantics"].partition("; ")[2] if models else ""
        looked = (self._count("semantics") - self._done) / minutes if models else 0.0
        print(
            f"| {name} | {size} | {took} | {(self._count('keyframes so far') - self._seen) / minutes:.0f}, {looked:.1f} | "
            f"{self.values['callback 99th percentile, ms']} | {self.values['worker load']} | "
            f"{memory_mb(self.pid, 'VmRSS'):.0f}, {memory_mb(self.pid, 'VmHWM'):.0f} |",
            flush=True,
        )


def measure(bag: Path, reference: Any, folder: Path, args: argparse.Namespace) -> None:
    """Run the node through all phases."""
    tried = [(make.__name__, *make(folder)) for make in FAMILIES if make.__name__ in args.only]
    plans = [("none", {}, ""), *tried, ("none again", {}, "")]
    with fed_node(bag, se3.perturb(reference, *OFF), folder, "online.max_load:=1.0") as fed:  # what models cost, not their share
        phases = Phases(fed, plans, args)
        print(HEAD)
        fed.run(len(plans) * phases.pairs, Pace(RATE, 0.5), phases.idle)
        phases.finish()
        values = phases.values
        last = values["last error"] or "none"
        print(f"\nestimates accepted: {values['estimates accepted']}; errors: {values['errors']}, the last: {last}")


def main() -> int:
    """Make the models, and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=DRIVE, help=f"as for calib-ros (default {DRIVE})")
    parser.add_argument("--seconds", type=float, default=70.0, help="of each phase (default 70)")
    parser.add_argument("--threads", type=int, default=1, help="semantics.threads (default 1)")
    names = [make.__name__ for make in FAMILIES]
    parser.add_argument("--only", nargs="*", default=names, choices=names, help="of the models (default all)")
    parser.add_argument("--out", metavar="FOLDER", help="keep bag, models and node.log here; reuses the bag")
    args = parser.parse_args()
    return on_recording("semantics_load", args.source, args.out, lambda bag, T, folder: measure(bag, T, folder, args))


if __name__ == "__main__":
    sys.exit(main())

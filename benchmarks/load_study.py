"""What the node costs at 10 Hz: CPU time of its process and memory, for some shares of a core that it may use.

    python -m benchmarks.load_study [SOURCE] [--seconds 60] [--max-load 0.3 0.5 1.0] [--out FOLDER]

SOURCE: as for calib-ros; by default the drive of the soak test. A node with its default configuration, in a process of its own,
is fed over DDS. CPU time is that of the whole process as the kernel counts it: other work on the same cores does not matter.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from benchmarks.fed_node import DRIVE, OFF, RATE, cpu_s, fed_node, memory_mb, on_recording
from calib_ros import se3
from calib_ros.online.pacing import Work
from calib_ros.result import CONVERGED
from calib_ros.ros.client import ExtrinsicClient

HEAD = f"""\
| max_load | CPU of the process, halves of the run | {", ".join(work.value for work in Work)} | keyframes a minute | estimates \
| pairs dropped | converged after | MB at most, at the end |
|---|---|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Moment:
    """Once a second. values: of /diagnostics."""

    wall_s: float
    cpu_s: float
    rss_mb: float
    values: dict[str, str]


class Watcher:
    """Writes down what the node does."""

    def __init__(self, client: ExtrinsicClient, pid: int) -> None:
        self.client, self.pid = client, pid
        self.moments: list[Moment] = []
        client._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        values = {v.key: v.value for v in msg.status[0].values}
        self.moments.append(Moment(time.monotonic(), cpu_s(self.pid), memory_mb(self.pid), values))

    def row(self, name: str, began: float) -> str:
        """Of the table."""
        fed = [m for m in self.moments if m.wall_s >= began]
        first, middle, last = fed[0], fed[len(fed) // 2], fed[-1]
        halves = [(b.cpu_s - a.cpu_s) / (b.wall_s - a.wall_s) for a, b in ((first, middle), (middle, last))]
        kinds = ", ".join(f"{float(last.values[f'CPU for {work.value}']):.2f}" for work in Work)
        keyframes = int(last.values["keyframes so far"]) / (last.wall_s - began) * 60
        dropped = int(last.values["pairs dropped by a busy worker"]) / max(int(last.values["pairs"]), 1)
        converged = next((f"{m.wall_s - began:.0f} s" for m in fed if m.values["status"] == CONVERGED), "-")
        return (
            f"| {name} | {halves[0]:.2f}, {halves[1]:.2f} | {kinds} | {keyframes:.0f} | {last.values['estimates accepted']} | "
            f"{dropped:.0%} | {converged} | {max(m.rss_mb for m in fed):.0f}, {last.rss_mb:.0f} |"
        )


def measure(bag: Path, reference: Any, folder: Path, max_load: float, args: argparse.Namespace) -> str:
    """One run of the node."""
    parameters = (f"online.max_load:={max_load}", *args.parameters)
    with fed_node(bag, se3.perturb(reference, *OFF), folder, *parameters) as fed:
        watcher, began = Watcher(fed.client, fed.process.pid), time.monotonic()
        fed.run(int(args.seconds * RATE), RATE)
        return watcher.row(f"{max_load:g}", began)


def main() -> int:
    """Feed, watch, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=DRIVE, help=f"as for calib-ros (default {DRIVE})")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run (default 60)")
    parser.add_argument(
        "--max-load", type=float, nargs="+", default=[0.3, 0.5, 1.0], help="online.max_load (default 0.3 0.5 1.0)"
    )
    parser.add_argument("--parameters", nargs="*", default=[], metavar="NAME:=VALUE", help="more parameters of the node")
    parser.add_argument("--out", metavar="FOLDER", help="keep bag and node.log here; reuses the bag")
    args = parser.parse_args()

    def measured(bag: Path, reference: Any, folder: Path) -> None:
        print(HEAD, flush=True)
        for max_load in args.max_load:
            print(measure(bag, reference, folder, max_load, args), flush=True)

    return on_recording("load_study", args.source, args.out, measured)


if __name__ == "__main__":
    sys.exit(main())

"""Soak test: hours of data through the node. Does its memory grow, is an estimate lost, are callbacks delayed?

    python -m benchmarks.soak [SOURCE] [--minutes 60] [--rate 30] [--out FOLDER] [--parameters NAME:=VALUE...]

SOURCE: as for calib-ros; by default a synthetic drive of 60 frames. It is written as a bag once and fed in laps over DDS, with
stamps that go on at 10 Hz of data time, to a node with its default configuration in a process of its own. Ends with 1 if memory
grew by more than 5 %, an estimate was lost, or callbacks took more than 10 ms (99th percentile) while the worker was busy.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from calib_ros_msgs.msg import Extrinsic
from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from benchmarks.fed_node import DRIVE, IMAGE, OFF, POINTS, Feeding, fed_node, memory_mb, on_recording
from benchmarks.records import markdown
from calib_ros import se3

PAIRS_PER_MINUTE = 600
P99 = "callback 99th percentile, ms"  # of the diagnostics
ASK_MINUTES = 5  # of data between calls of ~/calibrate
ANSWER_S = 120.0  # for the last call
TOLD_MINUTES = 5  # of data between lines of progress
MAX_GROWTH = 0.05  # of the memory, from the end of the warm-up to the end of the run
MAX_P99_MS = 10.0  # of the callbacks while the worker is busy
BUSY = 0.3  # worker load above which a sample counts as busy
WARM_UP, WARM_UP_KEYFRAMES = 0.1, 60  # share of the run, and keyframes: until the buffer has been full for a while


class Sample(NamedTuple):
    """The node once a second. rss_mb: resident memory. callback_p99_ms: of its last 2000 callbacks."""

    data_min: float
    rss_mb: float
    keyframes: int
    load: float
    callback_p99_ms: float


def warm_up_min(samples: Sequence[Sample]) -> float:
    """Minutes of data after which the memory should stay as it is; half of a run that is too short to tell."""
    end = samples[-1].data_min
    full = next((s.data_min for s in samples if s.keyframes >= WARM_UP_KEYFRAMES), end)
    return min(max(WARM_UP * end, full), 0.5 * end)


def memory(samples: Sequence[Sample]) -> tuple[float, float]:
    """MB after the warm-up and at the end: medians over a tenth of the run each."""
    at, rss = np.array([(s.data_min, s.rss_mb) for s in samples]).T
    start, tenth = warm_up_min(samples), at[-1] / 10
    after, end = (at >= start) & (at <= start + tenth), at >= at[-1] - tenth
    return float(np.median(rss[after])) if after.any() else float(rss[0]), float(np.median(rss[end]))


def callback_p99_ms(samples: Sequence[Sample]) -> float:
    """Median of the node's own figures under load; NaN if there was none."""
    busy = [s.callback_p99_ms for s in samples if s.load > BUSY and s.data_min >= warm_up_min(samples)]
    return float(np.median(busy)) if busy else float("nan")


class Watcher:
    """Records what the node publishes, and asks for an estimate now and then."""

    def __init__(self, fed: Feeding, pairs: int) -> None:
        self.fed, self._ask_pairs = fed, min(ASK_MINUTES * PAIRS_PER_MINUTE, max(pairs // 4, 1))
        self.values: dict[str, str] = {}
        self.samples: list[Sample] = []
        self.accepted = self.refused = 0
        self.calls: list[Any] = []
        node = fed.client._node
        self._calibrate = node.create_client(Trigger, "/calib_ros/calibrate")
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        node.create_subscription(Extrinsic, "/calib_ros/extrinsic", self._on_extrinsic, 100)

    def count(self, name: str) -> int:
        """Of the last diagnostics."""
        return int(self.values.get(name, 0))

    def _on_extrinsic(self, msg: Extrinsic) -> None:
        self.accepted += msg.status == Extrinsic.STATUS_CONVERGED
        self.refused += msg.status not in (Extrinsic.STATUS_CONVERGED, Extrinsic.STATUS_INITIAL)

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        self.values = {v.key: v.value for v in msg.status[0].values}
        if self.fed.ended() or not self.fed.feeder.sent[IMAGE]:
            return
        pairs, load, p99 = self.count("pairs"), *(float(self.values[name]) for name in ("worker load", P99))
        sample = Sample(pairs / PAIRS_PER_MINUTE, memory_mb(self.fed.process.pid), self.count("keyframes so far"), load, p99)
        if not self.samples or sample.data_min // TOLD_MINUTES > self.samples[-1].data_min // TOLD_MINUTES:
            print(f"{sample.data_min:6.1f} min of data  {sample.rss_mb:6.1f} MB  load {load:.2f}  p99 {p99:.2f} ms", flush=True)
        self.samples.append(sample)
        if pairs >= self._ask_pairs * (len(self.calls) + 1):
            self.ask()

    def ask(self) -> None:
        """Call ~/calibrate."""
        self.calls.append(self._calibrate.call_async(Trigger.Request()))

    def finish(self) -> None:
        """Ask for the last time, and wait for what is under way."""
        self.ask()
        self.fed.client.spin(ANSWER_S, lambda: self.fed.ended() or all(call.done() for call in self.calls))
        self.fed.client.spin(3.0, self.fed.ended)  # the last diagnostics

    @property
    def lost(self) -> int:
        """Calls that were never answered."""
        return sum(not call.done() for call in self.calls)

    def problems(self, tracebacks: int) -> list[str]:
        """What must not be."""
        start, end = memory(self.samples)
        p99 = callback_p99_ms(self.samples)
        found = {
            f"memory grew by {100 * (end / start - 1):.1f} %": end / start - 1 > MAX_GROWTH,
            f"{self.lost} of {len(self.calls)} estimates were never answered": self.lost > 0,
            "no estimate was accepted": not self.accepted,
            f"callbacks take {p99:.1f} ms (99th percentile) while the worker is busy": p99 > MAX_P99_MS,
            f"the node printed {tracebacks} tracebacks": tracebacks > 0,
        }
        return [problem for problem, there in found.items() if there]

    def table(self, reference: Any) -> str:
        """As Markdown; reference: T (4, 4), to compare the last answer with."""
        sent, (start, end) = self.fed.feeder.sent, memory(self.samples)
        success, message, result, _ = self.fed.client.get_extrinsic()
        T = result.T_camera_lidar
        error = f"{se3.rotation_error_deg(reference, T):.3f} deg, {100 * se3.translation_error_m(reference, T):.2f} cm"
        rows = [
            ("pairs, data time", f"{self.count('pairs')}, {self.samples[-1].data_min:.1f} min"),
            ("images sent, received", f"{sent[IMAGE]}, {self.count('images')}"),
            ("clouds sent, received", f"{sent[POINTS]}, {self.count('clouds')}"),
            ("pairs left out by a busy worker", self.count("pairs dropped by a busy worker")),
            ("keyframes", self.samples[-1].keyframes),
            ("estimates accepted, refused", f"{self.accepted}, {self.refused}"),
            ("~/calibrate asked, lost", f"{len(self.calls)}, {self.lost}"),
            ("memory after the warm-up, at the end", f"{start:.1f} MB, {end:.1f} MB"),
            ("callbacks under load, 99th percentile", f"{callback_p99_ms(self.samples):.2f} ms"),
            ("errors reported, the last", f"{self.count('errors')}, {self.values.get('last error', '') or 'none'}"),
            ("answer at the end", f"{result.status if success else 'none'}: {message}"),
            ("against the reference", error),
        ]
        return markdown(["", ""], rows)


def main() -> int:
    """Feed, watch, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=DRIVE, help=f"as for calib-ros (default {DRIVE})")
    parser.add_argument("--minutes", type=float, default=60.0, help="of data at 10 Hz (default 60)")
    parser.add_argument("--rate", type=float, default=30.0, help="pairs per second of wall time (default 30)")
    parser.add_argument("--out", metavar="FOLDER", help="keep bag and node.log here; reuses the bag")
    parser.add_argument("--parameters", nargs="*", default=[], metavar="NAME:=VALUE", help="more parameters of the node")
    args = parser.parse_args()
    problems: list[str] = []

    def soak(bag: Path, reference: Any, folder: Path) -> None:
        pairs = round(args.minutes * PAIRS_PER_MINUTE)
        with fed_node(bag, se3.perturb(reference, *OFF), folder, *args.parameters) as fed:
            watcher = Watcher(fed, pairs)
            fed.run(pairs, args.rate)
            watcher.finish()
            print(watcher.table(reference))
        tracebacks = (folder / "node.log").read_text(errors="replace").count("Traceback")
        problems.extend(watcher.problems(tracebacks))

    status = on_recording("soak", args.source, args.out, soak)
    for problem in problems:
        print(f"PROBLEM: {problem}")
    return status or int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())

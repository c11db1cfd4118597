"""Soak test: hours of data through the node. Does its memory grow, is an estimate lost, are callbacks delayed?

    python -m benchmarks.soak [SOURCE] [--minutes 60] [--rate auto] [--out FOLDER]

SOURCE: as for calib-ros; by default a synthetic drive of 60 frames. It is written as a bag once and fed in laps over DDS, with
stamps that go on at 10 Hz of data time, to a node with its default configuration in a process of its own. --rate auto: as fast as
the node takes. Ends with 1 if memory grew by more than 5 %, an estimate was lost, or callbacks took more than 10 ms (99th
percentile) while the worker was busy.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

from calib_ros_msgs.msg import Extrinsic
from diagnostic_msgs.msg import DiagnosticArray
from std_srvs.srv import Trigger

from benchmarks.fed_node import DRIVE, IMAGE, OFF, POINTS, Feeding, Pace, fed_node, memory_mb, on_recording
from benchmarks.soak_report import Run, Sample
from calib_ros import se3

PAIRS_PER_MINUTE = 600
ANSWER_S = 120.0  # for the last call of ~/calibrate


class Watcher:
    """Records what the node publishes and calls its services."""

    def __init__(self, fed: Feeding, run: Run, pace: Pace, ask_pairs: int) -> None:
        self.fed, self.run, self.pace, self.ask_pairs = fed, run, pace, ask_pairs
        self.values: dict[str, str] = {}
        self._began = time.monotonic()
        self._next_ask = ask_pairs
        self._printed_at = -1e9
        self._calls: list[Any] = []
        node = fed.client._node
        self._calibrate = node.create_client(Trigger, "/calib_ros/calibrate")
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        node.create_subscription(Extrinsic, "/calib_ros/extrinsic", self._on_extrinsic, 100)

    def count(self, name: str) -> int:
        return int(self.values.get(name, 0))

    def _on_extrinsic(self, msg: Extrinsic) -> None:
        if msg.status == Extrinsic.STATUS_CONVERGED:
            self.run.accepted += 1
        elif msg.status != Extrinsic.STATUS_INITIAL:
            self.run.refused += 1

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        self.values = {v.key: v.value for v in msg.status[0].values}
        pairs, left_out = self.count("pairs"), self.count("pairs dropped by a busy worker")
        self.pace.heard(pairs, left_out)
        if self.fed.ended() or not self.fed.feeder.sent[IMAGE]:
            return
        rss, shared = memory_mb(self.fed.process.pid)
        sample = Sample(
            time.monotonic() - self._began, pairs / PAIRS_PER_MINUTE, rss, shared, self.pace.rate, pairs, left_out,
            self.count("keyframes so far"), self.run.accepted, float(self.values["worker load"]),
            float(self.values["callback 99th percentile, ms"]), self.count("errors"),
        )  # fmt: skip
        self.run.samples.append(sample)
        if pairs >= self._next_ask:
            self._next_ask += self.ask_pairs
            self._ask()
        if sample.wall_s - self._printed_at >= 10:
            self._printed_at = sample.wall_s
            print(
                f"{sample.wall_s:6.0f} s  {sample.data_min:6.1f} min of data  {rss:6.1f} MB  {sample.rate:5.1f} pairs/s  "
                f"left out {left_out}  keyframes {sample.keyframes}  accepted {self.run.accepted}  load {sample.load:.2f}  p99 "
                f"{sample.callback_p99_ms:.2f} ms  errors {sample.errors}",
                flush=True,
            )

    def _ask(self) -> None:
        self.run.asked += 1
        self._calls.append(self._calibrate.call_async(Trigger.Request()))

    def finish(self, reference: Any) -> None:
        """Wait for what is under way, and compare the answer with the reference."""
        self._next_ask = sys.maxsize
        self._ask()
        self.fed.client.spin(ANSWER_S, lambda: self.fed.ended() or all(call.done() for call in self._calls))
        self.fed.client.spin(3.0, self.fed.ended)  # the last diagnostics
        run, sent = self.run, self.fed.feeder.sent
        run.answered = sum(call.done() for call in self._calls)
        run.sent = {topic: sent[topic] for topic in (IMAGE, POINTS)}
        run.received = {IMAGE: self.count("images"), POINTS: self.count("clouds")}
        run.last_error = self.values.get("last error", "")
        success, message, result, _ = self.fed.client.get_extrinsic()
        run.answer = f"{result.status}: {message}" if success else f"none: {message}"
        run.error_deg = se3.rotation_error_deg(reference, result.T_camera_lidar)
        run.error_m = se3.translation_error_m(reference, result.T_camera_lidar)


def soak(bag: Path, reference: Any, folder: Path, args: argparse.Namespace) -> Run:
    """One run over the bag; its CSV and plot are in the folder."""
    pairs = round(args.minutes * PAIRS_PER_MINUTE)
    run = Run(f"{args.source}, {args.minutes:g} min of data")
    pace = Pace(None if args.rate == "auto" else float(args.rate), args.left_out)
    with fed_node(bag, se3.perturb(reference, *OFF), folder) as fed:
        watcher = Watcher(fed, run, pace, min(5 * PAIRS_PER_MINUTE, max(pairs // 4, 1)))
        fed.run(pairs, pace)
        watcher.finish(reference)
    run.tracebacks = (folder / "node.log").read_text(errors="replace").count("Traceback")
    run.write(folder)
    return run


def main() -> int:
    """Feed, watch, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=DRIVE, help=f"as for calib-ros (default {DRIVE})")
    parser.add_argument("--minutes", type=float, default=60.0, help="of data at 10 Hz (default 60)")
    parser.add_argument("--rate", default="auto", help="pairs per second of wall time, or auto (default)")
    parser.add_argument("--left-out", type=float, default=0.5, metavar="SHARE", help="of pairs that auto accepts (default 0.5)")
    parser.add_argument("--out", metavar="FOLDER", help="keep bag, node.log, soak.csv and soak.png here; reuses the bag")
    args = parser.parse_args()
    runs: list[Run] = []
    status = on_recording("soak", args.source, args.out, lambda bag, T, folder: runs.append(soak(bag, T, folder, args)))
    if not runs:
        return status
    print(runs[0].table())
    for problem in runs[0].problems():
        print(f"PROBLEM: {problem}")
    return 1 if runs[0].problems() else 0


if __name__ == "__main__":
    sys.exit(main())

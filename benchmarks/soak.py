"""Soak test: hours of data through the node. Does its memory grow, is an estimate lost, are callbacks delayed?

    python -m benchmarks.soak [SOURCE] [--minutes 60] [--rate auto] [--out FOLDER]

SOURCE: as for calib-ros; by default a synthetic drive of 60 frames. It is written as a bag once and fed in laps over DDS, with
stamps that go on at 10 Hz of data time, to a node with its default configuration in a process of its own. --rate auto: as fast as
the node takes. Ends with 1 if memory grew by more than 5 %, an estimate was lost, or callbacks took more than 10 ms (99th
percentile) while the worker was busy.
"""

from __future__ import annotations

import argparse
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import rclpy
from calib_ros_msgs.msg import Extrinsic
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_srvs.srv import Trigger

from benchmarks.soak_report import Run, Sample
from calib_ros import se3
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS
from calib_ros.ros.bags import message_class
from calib_ros.ros.client import ExtrinsicClient

IMAGE, INFO, POINTS = "/camera/image_raw", "/camera/camera_info", "/velodyne_points"  # as bag_writer names them
GAP_NS = NANOSECONDS  # between two laps: the jump from the last scene to the first must not look like motion
LOWEST, HIGHEST = 2.0, 200.0  # pairs per second
STAMP = 4  # offset of the stamp in a message that begins with a header, behind the encapsulation
DRIVE = "synthetic:seed=1,frames=60,stride=1"
PAIRS_PER_MINUTE = 600
OFF = ([1.0, -0.8, 0.6], [0.06, -0.05, 0.04])  # deg, m: the initial extrinsic is this far off the reference
ANSWER_S = 120.0  # for the last call of ~/calibrate


def start_node(T: Any, folder: Path, *parameters: str) -> subprocess.Popen[bytes]:
    """The node as a user starts it: nothing is set but topics, the initial extrinsic, the state file, and more parameters as
    name:=value."""
    t, q = T[:3, 3].tolist(), se3.quaternion_from_rotation(T[:3, :3]).tolist()
    command = [sys.executable, "-m", "calib_ros.ros.node", "--ros-args"]
    for rule in (f"image:={IMAGE}", f"camera_info:={INFO}", f"points:={POINTS}"):
        command += ["-r", rule]
    for value in (
        f"initial_translation_m:={t}",
        f"initial_quaternion_xyzw:={q}",
        f"state_file:={folder / 'state.json'}",
        *parameters,
    ):
        command += ["-p", value]
    with (folder / "node.log").open("wb") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)


def memory_mb(pid: int) -> tuple[float, float]:
    """Resident memory, and the part of it that is shared (Fast DDS's segments)."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    values = {key: value for key, _, value in (line.partition(":") for line in lines)}
    rss, shared = (float(values[name].split()[0]) / 1024 for name in ("VmRSS", "RssShmem"))
    return rss, shared


@dataclass
class Recorded:
    """A message of the bag, whose stamp is written over before it goes out."""

    topic: str
    stamp: int
    data: bytearray


def recorded(bag: Path) -> list[Recorded]:
    """All images, infos and clouds of a bag, by stamp. They are held in memory."""
    file = BagFile(bag)
    messages = [Recorded(topic, peek_header(data)[0], bytearray(data)) for topic, _, data in file.raw([INFO, IMAGE, POINTS])]
    file.close()
    return sorted(messages, key=lambda message: message.stamp)


def restamped(messages: list[Recorded]) -> Iterator[Recorded]:
    """The messages without end; every lap follows the one before."""
    lap_ns = messages[-1].stamp - messages[0].stamp + GAP_NS
    for lap in count():
        for message in messages:
            seconds, rest = divmod(message.stamp + lap * lap_ns, NANOSECONDS)
            struct.pack_into(("<" if message.data[1] & 1 else ">") + "iI", message.data, STAMP, seconds, rest)
            yield message


class Pace:
    """Pairs per second: fixed, or as fast as the node takes them.

    The node never falls behind: a busy worker leaves pairs out. So the rate rises until more than `share` of the pairs of the
    last seconds were left out or a message was lost, and then stays a little below.
    """

    def __init__(self, fixed: float | None, share: float) -> None:
        self.rate = fixed or 10.0
        self._fixed, self._share = fixed is not None, share
        self._seen: list[tuple[int, int]] = []

    def heard(self, pairs: int, left_out: int) -> None:
        """The node's counts, once a second."""
        self._seen = [*self._seen[-5:], (pairs, left_out)]
        if self._fixed or len(self._seen) < 6:
            return
        new, lost = (self._seen[-1][k] - self._seen[0][k] for k in (0, 1))
        if lost > self._share * new:
            self.rate = max(0.85 * self.rate, LOWEST)
            self._seen = self._seen[-1:]  # losses at the old rate do not count at the new one
        elif new > 0.9 * 5 * self.rate:  # else we are the slow ones
            self.rate = min(1.04 * self.rate, HIGHEST)


class Feeder:
    """Publishers of the three topics."""

    def __init__(self, node: Node, messages: list[Recorded], types: dict[str, str]) -> None:
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
        self._publishers: dict[str, Any] = {
            topic: node.create_publisher(message_class(kind), topic, qos) for topic, kind in types.items()
        }
        self._messages = messages
        self.sent = dict.fromkeys(types, 0)

    @property
    def heard(self) -> bool:
        """True if every topic has a subscriber."""
        return all(publisher.get_subscription_count() for publisher in self._publishers.values())

    def run(self, pairs: int, pace: Pace, idle: Callable[[float], None], stopped: Callable[[], bool]) -> None:
        """Publish so many pairs. idle: called with the time at which the next one is due, at least once for each."""
        due = time.monotonic()
        for message in restamped(self._messages):
            if message.topic == IMAGE:
                if self.sent[IMAGE] == pairs or stopped():
                    return
                due = max(due + 1 / pace.rate, time.monotonic() - 1 / pace.rate)  # a delay is not made up for in a burst
                idle(due)
            self._publishers[message.topic].publish(bytes(message.data))
            self.sent[message.topic] += 1


class Watcher:
    """Records what the node publishes and calls its services."""

    def __init__(self, client: ExtrinsicClient, node: subprocess.Popen[bytes], run: Run, pace: Pace, ask_pairs: int) -> None:
        self.client, self.node, self.run, self.pace, self.ask_pairs = client, node, run, pace, ask_pairs
        self.values: dict[str, str] = {}
        self.feeder: Feeder | None = None
        self._began = time.monotonic()
        self._next_ask = ask_pairs
        self._printed_at = -1e9
        self._calls: list[Any] = []
        self._calibrate = client._node.create_client(Trigger, "/calib_ros/calibrate")
        client._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        client._node.create_subscription(Extrinsic, "/calib_ros/extrinsic", self._on_extrinsic, 100)

    def idle(self, until: float) -> None:
        """Listen until the time has come, once at least."""
        while True:
            self.client._executor.spin_once(timeout_sec=max(until - time.monotonic(), 0.0))
            if time.monotonic() >= until:
                return

    def stopped(self) -> bool:
        """True if there is nothing left to feed."""
        return self.node.poll() is not None

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
        if self.node.poll() is not None or self.feeder is None or not self.feeder.sent[IMAGE]:
            return
        rss, shared = memory_mb(self.node.pid)
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
        self.client.spin(ANSWER_S, lambda: self.stopped() or all(call.done() for call in self._calls))
        self.client.spin(3.0, self.stopped)  # the last diagnostics
        run, sent = self.run, self.feeder.sent if self.feeder else {}
        run.answered = sum(call.done() for call in self._calls)
        run.sent = {topic: sent[topic] for topic in (IMAGE, POINTS)}
        run.received = {IMAGE: self.count("images"), POINTS: self.count("clouds")}
        run.last_error = self.values.get("last error", "")
        success, message, result, _ = self.client.get_extrinsic()
        run.answer = f"{result.status}: {message}" if success else f"none: {message}"
        run.error_deg = se3.rotation_error_deg(reference, result.T_camera_lidar)
        run.error_m = se3.translation_error_m(reference, result.T_camera_lidar)


def soak(bag: Path, reference: Any, folder: Path, args: argparse.Namespace) -> Run:
    """One run over the bag."""
    file = BagFile(bag)
    types = {topic: file.topics[topic].type for topic in (IMAGE, INFO, POINTS)}
    file.close()
    pairs = round(args.minutes * PAIRS_PER_MINUTE)
    run = Run(f"{args.source}, {args.minutes:g} min of data")
    pace = Pace(None if args.rate == "auto" else float(args.rate), args.left_out)
    node = start_node(se3.perturb(reference, *OFF), folder)
    try:
        with ExtrinsicClient() as client:
            client.get_extrinsic(60)
            watcher = Watcher(client, node, run, pace, min(5 * PAIRS_PER_MINUTE, max(pairs // 4, 1)))
            feeder = watcher.feeder = Feeder(client._node, recorded(bag), types)
            if not client.spin(30, lambda: feeder.heard):
                raise CalibrationError(f"the node does not listen; see {folder / 'node.log'}")
            client.spin(1.0)  # discovery has two sides
            feeder.run(pairs, pace, watcher.idle, watcher.stopped)
            if watcher.stopped():
                raise CalibrationError(f"the node ended with {node.returncode}; see {folder / 'node.log'}")
            watcher.finish(reference)
        node.send_signal(signal.SIGINT)
        node.wait(10)
    finally:
        if node.poll() is None:
            node.kill()
        node.wait()
    run.tracebacks = (folder / "node.log").read_text(errors="replace").count("Traceback")
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
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(args.out or scratch)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            source = open_dataset(args.source)
            if source.reference is None:
                raise CalibrationError(f"{source.name} states no reference extrinsic; give KITTI, or synthetic")
            bag = folder / f"bag_{zlib.crc32(str(args.source).encode()):08x}"  # of this source and no other
            if not bag.exists():
                print(f"writing {len(source)} frames to {bag}", flush=True)
                write_bag(source, bag)
            run = soak(bag, source.reference, folder, args)
        except CalibrationError as error:
            print(f"soak: {error}", file=sys.stderr)
            return 2
        finally:
            rclpy.try_shutdown()
        run.write(folder)
    print(run.table())
    for problem in run.problems():
        print(f"PROBLEM: {problem}")
    return 1 if run.problems() else 0


if __name__ == "__main__":
    sys.exit(main())

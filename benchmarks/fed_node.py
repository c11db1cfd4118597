"""A real node in a process of its own, fed over DDS with a recording: what benchmarks of the node share."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

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
STAMP = 4  # offset of the stamp in a message that begins with a header, behind the encapsulation
DRIVE = "synthetic:seed=1,frames=60,stride=1"
RATE = 10.0  # pairs per second of the benchmarks that fix it
OFF = ([1.0, -0.8, 0.6], [0.06, -0.05, 0.04])  # deg, m: the initial extrinsic is this far off the reference
TICK = os.sysconf("SC_CLK_TCK")


def start_node(T: Any, folder: Path, *parameters: str) -> subprocess.Popen[bytes]:
    """The node as a user starts it: nothing is set but topics, the initial extrinsic, the state file, and more parameters as
    name:=value."""
    t, q = T[:3, 3].tolist(), se3.quaternion_from_rotation(T[:3, :3]).tolist()
    command = [sys.executable, "-m", "calib_ros.ros.process", "--ros-args"]
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


def memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS:"))


def cpu_s(pid: int) -> float:
    """CPU time of a process so far, in user and system mode."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICK


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


class Feeder:
    """Publishers of the three topics."""

    def __init__(self, node: Node, messages: list[Recorded], types: dict[str, str]) -> None:
        qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
        self._publishers: dict[str, Any] = {
            topic: node.create_publisher(message_class(kind), topic, qos) for topic, kind in types.items()
        }
        self._messages = restamped(messages)
        self.sent = dict.fromkeys(types, 0)

    @property
    def heard(self) -> bool:
        """True if every topic has a subscriber."""
        return all(publisher.get_subscription_count() for publisher in self._publishers.values())

    def run(self, pairs: int, rate: float, idle: Callable[[float], None], stopped: Callable[[], bool]) -> None:
        """Publish until so many pairs are sent, `rate` a second; the next call goes on behind them. idle: called with the time at
        which the next one is due, once for each."""
        due = time.monotonic()
        for message in self._messages:
            if message.topic == IMAGE:
                if self.sent[IMAGE] == pairs or stopped():
                    self._messages = chain([message], self._messages)
                    return
                due = max(due + 1 / rate, time.monotonic() - 1 / rate)  # a delay is not made up for in a burst
                idle(due)
            self._publishers[message.topic].publish(bytes(message.data))
            self.sent[message.topic] += 1


class Feeding:
    """A node that listens, and the publishers that feed it."""

    def __init__(self, client: ExtrinsicClient, process: subprocess.Popen[bytes], feeder: Feeder, log: Path) -> None:
        self.client, self.process, self.feeder, self._log = client, process, feeder, log

    def ended(self) -> bool:
        """True if the node is not there any more."""
        return self.process.poll() is not None

    def idle(self, until: float) -> None:
        """Listen until the time has come, once at least."""
        while True:
            self.client._executor.spin_once(timeout_sec=max(until - time.monotonic(), 0.0))
            if time.monotonic() >= until:
                return

    def run(self, pairs: int, rate: float) -> None:
        """Publish so many pairs, `rate` a second. CalibrationError if the node ends meanwhile."""
        self.feeder.run(pairs, rate, self.idle, self.ended)
        self.check()

    def check(self) -> None:
        """CalibrationError if the node has ended."""
        if self.ended():
            raise CalibrationError(f"the node ended with {self.process.returncode}; see {self._log}")


@contextmanager
def fed_node(bag: Path, start: Any, folder: Path, *parameters: str, draws: bool = True) -> Iterator[Feeding]:
    """The node, from a start T (4, 4), and publishers of a bag's messages that it has found; ended by SIGINT afterwards.
    draws: overlays."""
    file = BagFile(bag)
    types = {topic: file.topics[topic].type for topic in (IMAGE, INFO, POINTS)}
    file.close()
    (folder / "state.json").unlink(missing_ok=True)
    node = start_node(start, folder, *parameters)
    try:
        with ExtrinsicClient(draws=draws) as client:
            client.get_extrinsic(60)
            feeder = Feeder(client._node, recorded(bag), types)
            if not client.spin(30, lambda: feeder.heard):
                raise CalibrationError(f"the node does not listen; see {folder / 'node.log'}")
            client.spin(1.0)  # discovery has two sides
            yield Feeding(client, node, feeder, folder / "node.log")
        node.send_signal(signal.SIGINT)
        node.wait(10)
    finally:
        if node.poll() is None:
            node.kill()
        node.wait()


def on_recording(program: str, name: str, out: str | None, measure: Callable[[Path, Any, Path], None]) -> int:
    """Write a source as a bag into the folder `out`, or a scratch one, and measure(bag, T, folder) with its reference T (4, 4).

    Returns the exit status: 2, with a line on stderr, where anything is missing.
    """
    own_network()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(out or scratch)
        folder.mkdir(parents=True, exist_ok=True)
        try:
            source = open_dataset(name)
            if source.reference is None:
                raise CalibrationError(f"{source.name} states no reference extrinsic; give KITTI, or synthetic")
            bag = folder / f"bag_{zlib.crc32(name.encode()):08x}"  # of this source and no other
            if not bag.exists():
                print(f"writing {len(source)} frames to {bag}", flush=True)
                write_bag(source, bag)
            measure(bag, source.reference, folder)
        except CalibrationError as error:
            print(f"{program}: {error}", file=sys.stderr)
            return 2
        finally:
            rclpy.try_shutdown()
    return 0


def own_network() -> None:
    """Nothing but this machine hears what is published, unless the environment says otherwise."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

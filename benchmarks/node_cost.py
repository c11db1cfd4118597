"""What the node costs: CPU time of its process, memory and callback times, fed over DDS as by drivers.

    python -m benchmarks.node_cost [SOURCE ...] [--seconds 60] [--settle 0] [--speed 1] [--cameras N ...] [--bare] [--soak]
        [-p NAME:=VALUE ...] [--out FOLDER]

SOURCE: as for calib-ros, or a synthetic rig; by default a synthetic drive. It is written as a bag once and played lap after lap,
with stamps that go on, to a node in a process of its own with its default configuration. A row is printed for each. CPU time is
that of the whole process as the kernel counts it: other work on the same cores does not matter much.

load  --seconds 120 -p online.max_load:=0.3
rest  --settle 45 --bare                      from the right extrinsic; next to a bare rclpy subscriber of the same topics
rig   'synthetic:rig=six_cameras_one_lidar,frames=4,width=480' --cameras 1 2 6
soak  --seconds 3600 --speed 3 --soak         ends with 1 if memory grew by more than 5 %, an answer of ~/calibrate was lost,
                                              nothing was accepted, callbacks took more than 10 ms under load (99th percentile),
                                              or the log has a traceback
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import count, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from calib_ros import se3
from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.bag_writer import DESCRIPTION, write_bag, write_rig_bag
from calib_ros.datasets.open import named_rig, open_dataset
from calib_ros.datasets.rig import RecordedRig
from calib_ros.errors import CalibrationError
from calib_ros.frame import NANOSECONDS
from calib_ros.online.pacing import Work
from calib_ros.result import CONVERGED
from calib_ros.ros.bags import message_class
from calib_ros.ros.dds import use_large_message_profile

DRIVE = "synthetic:seed=1,frames=60,stride=1"
IMAGE, INFO, POINTS = "/camera/image_raw", "/camera/camera_info", "/velodyne_points"  # as bag_writer names them
OFF = ([1.0, -0.8, 0.6], [0.06, -0.05, 0.04])  # deg, m: the initial extrinsic is this far off the reference
SPACING_NS = 90_000_000  # between images of a topic: at most 10 Hz are fed
LEAD_NS = 250_000_000  # a scan lies before the first image of a lap: without one its motion is unknown
GAP_NS = NANOSECONDS  # between two laps: the jump from the last scene to the first must not look like motion
STAMP = 4  # offset of the stamp in a message that begins with a header, behind the encapsulation
LATE_S = 0.1  # a longer delay is not made up for in a burst
TICK = os.sysconf("SC_CLK_TCK")
HEAD = f"""\
| source | CPU of the process, thirds of the run | at the end for {", ".join(work.value for work in Work)} \
| keyframes, estimates a minute of data | pairs dropped | converged after | callbacks, 99 % within, ms | MB at most, at the end \
| bare: CPU, MB |
|---|---|---|---|---|---|---|---|---|"""
BARE = """
import importlib, rclpy
from rclpy.qos import qos_profile_sensor_data
rclpy.init()
node = rclpy.create_node("bare")
for topic, kind in {types}.items():
    package, _, name = kind.split("/")
    message = getattr(importlib.import_module(package + ".msg"), name)
    node.create_subscription(message, topic, lambda msg: None, qos_profile_sensor_data)
try:
    rclpy.spin(node)
except BaseException:
    pass
"""
# Of a soak.
ASK_S, ANSWER_S = 300.0, 120.0  # of data between calls of ~/calibrate; for the last answer
MAX_GROWTH, MAX_P99_MS = 0.05, 10.0  # of the memory after the warm-up; of callbacks while the worker is busy
BUSY, WARM_UP_KEYFRAMES = 0.3, 60  # worker load that counts as busy; until the buffer has been full for a while


class Run(NamedTuple):
    """name: of its row. topics: of the bag. options: of the node."""

    name: str
    bag: Path
    topics: list[str]
    options: list[str]


def bag_of(text: str, folder: Path, write: Callable[[Path], object]) -> Path:
    """Of this source and no other, written where it is missing."""
    bag = folder / f"bag_{zlib.crc32(text.encode()):08x}"
    if not bag.exists():
        print(f"writing {text} to {bag}", file=sys.stderr)
        write(bag)
    return bag


def pair_run(text: str, folder: Path, right: bool) -> Run:
    """As a user starts it: nothing is set but topics, the initial extrinsic and the state file."""
    source = open_dataset(text)
    if source.reference is None:
        raise CalibrationError(f"{source.name} states no reference extrinsic; give KITTI, or synthetic")
    T = source.reference if right else se3.perturb(source.reference, *OFF)
    state = folder / "state.json"
    state.unlink(missing_ok=True)
    values = {
        "initial_translation_m": T[:3, 3].tolist(),
        "initial_quaternion_xyzw": se3.quaternion_from_rotation(T[:3, :3]).tolist(),
        "state_file": state,
    }
    topics = {"image": IMAGE, "camera_info": INFO, "points": POINTS}
    options = [word for name, topic in topics.items() for word in ("-r", f"{name}:={topic}")]
    options += [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    return Run(text, bag_of(text, folder, partial(write_bag, source)), list(topics.values()), options)


def rig_run(text: str, rig: RecordedRig, folder: Path, cameras: int | None) -> Run:
    """Of the first cameras and the first LiDAR, or of all sensors."""
    bag = bag_of(text, folder, partial(write_rig_bag, rig))
    described = yaml.safe_load(Path(f"{bag}{DESCRIPTION}").read_text())
    names = [*rig.lidars, *rig.cameras] if cameras is None else [*list(rig.lidars)[:1], *list(rig.cameras)[:cameras]]
    described["sensors"] = sensors = {name: described["sensors"][name] for name in names}
    file = folder / f"rig_{cameras}.yaml"
    file.write_text(yaml.safe_dump(described))
    topics = [topic for s in sensors.values() for topic in (s["topic"], s.get("camera_info")) if topic]
    return Run(f"{text}, {len(names)} sensors", bag, topics, ["-p", f"rig_file:={file}"])


# ------------------------------------------------------------------------------------------------ feeding


@dataclass
class Recorded:
    """A message of the bag, whose stamp is written over before it goes out."""

    topic: str
    stamp: int
    data: bytearray


def recorded(run: Run) -> tuple[list[Recorded], dict[str, str]]:
    """The messages that are fed, by stamp, held in memory; and the types of the topics."""
    file, kept = BagFile(run.bag), list[Recorded]()
    last: dict[str, int] = defaultdict(lambda: -SPACING_NS)
    for topic, _, data in file.raw(run.topics):
        stamp = peek_header(data)[0]
        if stamp - last[topic] >= SPACING_NS:
            last[topic] = stamp
            kept.append(Recorded(topic, stamp, bytearray(data)))
    types = {topic: file.topics[topic].type for topic in run.topics}
    file.close()
    scans = {topic for topic, kind in types.items() if kind.endswith("PointCloud2")}
    begin = min(m.stamp for m in kept) + LEAD_NS
    return sorted((m for m in kept if m.stamp >= begin or m.topic in scans), key=lambda message: message.stamp), types


def laps(messages: Sequence[Recorded]) -> Iterator[tuple[float, Recorded]]:
    """The messages without end, with the seconds of data before them; every lap follows the one before."""
    first = messages[0].stamp
    lap_ns = messages[-1].stamp - first + GAP_NS
    for lap in count():
        for message in messages:
            stamp = message.stamp + lap * lap_ns
            struct.pack_into(("<" if message.data[1] & 1 else ">") + "iI", message.data, STAMP, *divmod(stamp, NANOSECONDS))
            yield (stamp - first) / NANOSECONDS, message


def cpu_s(pid: int) -> float:
    """CPU time of a process so far, in user and system mode."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICK


def memory_mb(pid: int) -> float:
    """Resident memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS:"))


class Sample(NamedTuple):
    """Once a second. data_s: that were fed. cpu_s, mb: of the node and, if there is one, of the bare subscriber. values: of
    /diagnostics, by pair."""

    wall_s: float
    data_s: float
    cpu_s: list[float]
    mb: list[float]
    values: list[dict[str, str]]

    def total(self, name: str) -> float:
        """Of all pairs."""
        return sum(float(values[name]) for values in self.values)

    @property
    def converged(self) -> bool:
        return bool(self.values) and all(values["status"] == CONVERGED for values in self.values)

    @property
    def callback_p99_ms(self) -> float:
        """Of the last 2000 callbacks, of the slowest pair."""
        return max((float(values["callback 99th percentile, ms"]) for values in self.values), default=math.nan)


class Driver:
    """Plays the sensors, hears what the node says of itself, and writes down what processes use. calls: of ~/calibrate."""

    def __init__(self, types: dict[str, str], processes: Sequence[subprocess.Popen[bytes]], asks: bool) -> None:
        self.samples: list[Sample] = []
        self.calls: list[Any] = []
        self._processes, self._asks = processes, asks
        self._node = rclpy.create_node("drivers")
        qos = QoSProfile(depth=20)
        self._publishers = {topic: self._node.create_publisher(message_class(kind), topic, qos) for topic, kind in types.items()}
        self._values: dict[str, dict[str, str]] = {}
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)
        self._calibrate = self._node.create_client(Trigger, "/calib_ros/calibrate")

    def _on_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            if status.name.endswith(": extrinsic"):
                self._values[status.name] = {v.key: v.value for v in status.values}

    def spin(self, until: float) -> None:
        """Listen until the time has come, once at least."""
        while True:
            rclpy.spin_once(self._node, timeout_sec=max(until - time.monotonic(), 0.0))
            if time.monotonic() >= until:
                return

    def find(self) -> None:
        """Wait until all listen."""
        while not all(p.get_subscription_count() >= len(self._processes) for p in self._publishers.values()):
            self.spin(time.monotonic() + 0.1)
            self.check()
        self.spin(time.monotonic() + 1.0)  # discovery has two sides

    def play(self, messages: Sequence[Recorded], seconds: float, speed: float) -> None:
        """So many seconds of data, `speed` times as fast."""
        began = told = time.monotonic()
        for at, message in laps(messages):
            self.spin(began + at / speed)
            began = max(began, time.monotonic() - at / speed - LATE_S)
            self._publishers[message.topic].publish(bytes(message.data))
            if self._asks and at >= min(ASK_S, seconds / 4) * (len(self.calls) + 1):
                self.ask()
            if (now := time.monotonic()) >= told + 1:
                told = now
                self.sample(at)
            if at > seconds:
                return

    def check(self) -> None:
        """CalibrationError if the node has ended."""
        if self._processes[0].poll() is not None:
            raise CalibrationError(f"the node ended with {self._processes[0].returncode}; see node.log (--out)")

    def sample(self, data_s: float) -> None:
        self.check()
        cpu, mb = ([measure(process.pid) for process in self._processes] for measure in (cpu_s, memory_mb))
        self.samples.append(Sample(time.monotonic(), data_s, cpu, mb, list(self._values.values())))

    def ask(self) -> None:
        """Call ~/calibrate."""
        self.calls.append(self._calibrate.call_async(Trigger.Request()))

    def finish(self) -> None:
        """Ask for the last time, and wait for what is under way."""
        self.ask()
        end = time.monotonic() + ANSWER_S
        while time.monotonic() < end and not all(call.done() for call in self.calls):
            self.spin(time.monotonic() + 0.1)


@contextmanager
def process_of(command: list[str], log: Path, packages: Path | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """Ended by SIGINT afterwards. packages: a folder with those of another version."""
    env = os.environ if packages is None else {**os.environ, "PYTHONPATH": str(packages)}
    with log.open("wb") as file:
        process = subprocess.Popen(command, env=env, stdout=file, stderr=subprocess.STDOUT)
    try:
        yield process
        process.send_signal(signal.SIGINT)
        process.wait(30)
    finally:
        process.kill()
        process.wait()


# ------------------------------------------------------------------------------------------------ what is told


def row(name: str, samples: Sequence[Sample], settle: float) -> str:
    """Of the table, of what came after the data that settle the node."""
    fed = [s for s in samples if s.data_s >= settle]
    first, last = fed[0], fed[-1]
    ends = [fed[round(k * (len(fed) - 1) / 3)] for k in range(4)]
    thirds = [(b.cpu_s[0] - a.cpu_s[0]) / (b.wall_s - a.wall_s) for a, b in pairwise(ends)]
    minutes = (last.data_s - first.data_s) / 60
    counts = [(last.total(key) - first.total(key)) / minutes for key in ("keyframes so far", "estimates accepted")]
    dropped = last.total("pairs dropped by a busy worker") / max(last.total("pairs"), 1)
    cells = [
        name,
        " ".join(f"{share:.2f}" for share in thirds),
        " ".join(f"{last.total(f'CPU for {work.value}'):.3f}" for work in Work),
        ", ".join(f"{n:.0f}" for n in counts),
        f"{dropped:.0%}",
        next((f"{s.data_s:.0f} s" for s in samples if s.converged), "-"),
        f"{last.callback_p99_ms:.1f}",
        f"{max(s.mb[0] for s in fed):.0f}, {last.mb[0]:.0f}",
        *(
            f"{(b - a) / (last.wall_s - first.wall_s):.3f}, {mb:.0f}"
            for a, b, mb in zip(first.cpu_s[1:], last.cpu_s[1:], last.mb[1:], strict=True)
        ),
    ]
    return f"| {' | '.join(cells)} |"


def problems(samples: Sequence[Sample], calls: Sequence[Any], log: str) -> list[str]:
    """What must not be in a soak. Memory: medians over a tenth of the run, from the end of the warm-up on, which takes half of a
    run that is too short to tell."""
    end = samples[-1].data_s
    full = next((s.data_s for s in samples if s.values and s.total("keyframes so far") >= WARM_UP_KEYFRAMES), end)
    warm = [s for s in samples if s.data_s >= min(max(0.1 * end, full), 0.5 * end)]
    before, after = ([s.mb[0] for s in part] for part in (warm[: len(samples) // 10 + 1], samples[-len(samples) // 10 :]))
    growth = np.median(after) / np.median(before) - 1
    busy = [s.callback_p99_ms for s in warm if s.total("worker load") > BUSY]
    p99 = np.median(busy) if busy else 0.0
    lost = sum(not call.done() for call in calls)
    tracebacks = log.count("Traceback")
    found = {
        f"memory grew by {100 * growth:.1f} %": growth > MAX_GROWTH,
        f"{lost} of {len(calls)} calls of ~/calibrate were never answered": lost > 0,
        "no estimate was accepted": not samples[-1].total("estimates accepted"),
        f"callbacks take {p99:.1f} ms (99th percentile) while the worker is busy": p99 > MAX_P99_MS,
        f"the node printed {tracebacks} tracebacks": tracebacks > 0,
    }
    return [problem for problem, there in found.items() if there]


def measure(run: Run, folder: Path, args: argparse.Namespace) -> list[str]:
    """Feed, watch, print a row; what a soak has found."""
    messages, types = recorded(run)
    node = [sys.executable, "-m", "calib_ros.ros.process", "--ros-args", *run.options]
    node += [word for value in args.given for word in ("-p", value)]
    bare = [sys.executable, "-c", BARE.format(types=types)]
    log = folder / "node.log"
    rclpy.init()
    try:
        with ExitStack() as stack:
            processes = [stack.enter_context(process_of(node, log, args.packages))]
            if args.bare:
                processes.append(stack.enter_context(process_of(bare, folder / "bare.log")))
            driver = Driver(types, processes, args.soak)
            driver.find()
            driver.play(messages, args.settle + args.seconds, args.speed)
            if args.soak:
                driver.finish()
    finally:
        rclpy.shutdown()
    print(row(run.name, driver.samples, args.settle), flush=True)
    return problems(driver.samples, driver.calls, log.read_text(errors="replace")) if args.soak else []


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", default=[DRIVE], metavar="SOURCE", help=f"default {DRIVE}")
    parser.add_argument("--seconds", type=float, default=60.0, help="of data that count (default 60)")
    parser.add_argument("--settle", type=float, default=0.0, help="of data before them, from the right extrinsic")
    parser.add_argument("--speed", type=float, default=1.0, help="how many times as fast as recorded (default 1)")
    parser.add_argument("--cameras", nargs="+", type=int, default=[None], metavar="N", help="of a rig, with its first LiDAR")
    parser.add_argument("--bare", action="store_true", help="measure a bare subscriber as well")
    parser.add_argument("--soak", action="store_true", help="look for leaks and lost answers")
    parser.add_argument("-p", action="append", default=[], dest="given", metavar="NAME:=VALUE", help="a parameter of the node")
    parser.add_argument("--packages", type=Path, metavar="FOLDER", help="with another version, whose node is measured")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="keep bags and logs here; reuses the bags")
    args = parser.parse_args()
    use_large_message_profile()
    # Nothing but this machine hears what is published, unless the environment says otherwise.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    found = list[str]()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.out or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        print(HEAD, flush=True)
        try:
            for text in args.sources:
                rig = named_rig(text)
                for n in args.cameras:
                    run = rig_run(text, rig, folder, n) if rig else pair_run(text, folder, args.settle > 0)
                    found += measure(run, folder, args)
        except CalibrationError as error:
            parser.error(str(error))
    for problem in found:
        print(f"PROBLEM: {problem}")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())

"""What the node of a rig costs, by its number of cameras: CPU time of its process and memory, relative to one camera.

    python -m benchmarks.rig_load [SOURCE] [--cameras 1 2 6] [--lidars 1] [--seconds 60] [--dies front 60 90] [--out FOLDER]
        [-p NAME:=VALUE ...]

SOURCE: a synthetic rig. Its sensors are published at their own rates, but at most at 10 Hz, to the node in another process. What
the node says of the rig is printed with times. --dies: a sensor that sends nothing from and to so many seconds.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import rclpy
import yaml
from calib_ros_msgs.msg import Rig
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.qos import QoSProfile

from benchmarks.fed_node import Recorded, cpu_s, memory_mb, own_network, restamped
from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.bag_writer import DESCRIPTION, write_rig_bag
from calib_ros.frame import NANOSECONDS
from calib_ros.online.pacing import Work
from calib_ros.ros.bags import message_class
from calib_ros.ros.dds import LATCHED
from calib_ros_synthetic.rig import SyntheticRig

DRIVE = "synthetic:rig=six_cameras_two_lidars,seed=3,frames=4,width=480,clocks=0,speed=4"
SPACING_NS, LEAD_NS = 90_000_000, 250_000_000
HEAD = """\
| cameras | share of a core, thirds of the run | at the end for messages, intake, keyframes, classes, estimates | MB \
| keyframes, estimates, pairs | dropped | usable |
|---|---|---|---|---|---|---|"""


def thinned(bag: Path, topics: list[str]) -> list[Recorded]:
    """Messages of a bag in the order of time, images at most at 10 Hz."""
    file, kept = BagFile(bag), list[Recorded]()
    last: dict[str, int] = defaultdict(lambda: -SPACING_NS)
    for topic, _, data in file.raw(topics):
        stamp = peek_header(data)[0]
        if stamp - last[topic] >= SPACING_NS:
            last[topic] = stamp
            kept.append(Recorded(topic, stamp, bytearray(data)))
    file.close()
    # A scan lies before the first image of a lap: without one its motion is unknown.
    begin = min(m.stamp for m in kept) + LEAD_NS
    return sorted((m for m in kept if m.stamp >= begin or m.topic.endswith("points")), key=lambda message: message.stamp)


Silence = tuple[str, float, float]  # name of a sensor that sends nothing from and to so many seconds


def play(node: Any, publishers: dict[str, Any], messages: list[Recorded], seconds: float, dies: Silence) -> Iterator[float]:
    """Publish in real time; yields the time so far, s, once a second."""
    began, first, told = time.monotonic(), messages[0].stamp, 0
    lap_ns, before, offset = messages[-1].stamp - first + NANOSECONDS, 0, 0
    for message in restamped(messages):
        offset += lap_ns if message.stamp < before else 0
        before = message.stamp
        due = began + (message.stamp - first + offset) / NANOSECONDS
        while (rest := due - time.monotonic()) > 0:
            rclpy.spin_once(node, timeout_sec=rest)
        if not (message.topic.startswith(f"/{dies[0]}/") and dies[1] <= time.monotonic() - began < dies[2]):
            publishers[message.topic].publish(bytes(message.data))
        if (now := time.monotonic() - began) >= told + 1:
            told += 1
            yield now
        if now > seconds:
            return


def said(heard: list[tuple[float, Rig]], began: float) -> str:
    """What was said of the rig, a line for every change: seconds, the text, and sensors that are not usable or not converged."""
    lines, before = list[str](), list[tuple[str, str, bool]]()
    for at, rig in heard:
        wrong = [s for s in rig.sensors if not s.usable or s.status not in ("converged", "reference")]
        now = [(s.name, s.status, s.usable) for s in wrong]
        if now != before:
            before = now
            names = (f"{s.name} {s.status}{f' ({s.reason})' * (s.status in ('unchecked', 'moved'))}" for s in wrong)
            lines.append(f"{at - began:6.1f} s: {rig.text}; {', '.join(names) or 'all converged'}")
    return "\n".join(lines)


def measure(
    bag: Path, folder: Path, cameras: int, lidars: int, seconds: float, given: list[str], dies: Silence
) -> tuple[str, str]:
    """A row of the table, and what was said of the rig."""
    whole = yaml.safe_load(Path(f"{bag}{DESCRIPTION}").read_text())
    most = {"camera": cameras, "lidar": lidars}
    names = [n for kind, k in most.items() for n in [n for n, s in whole["sensors"].items() if s["kind"] == kind][:k]]
    sensors = {n: s for n, s in whole["sensors"].items() if n in names}
    file = folder / f"rig_{cameras}.yaml"
    file.write_text(yaml.safe_dump({"reference": whole["reference"], "sensors": sensors}))
    topics = [t for s in sensors.values() for t in (s["topic"], s.get("camera_info")) if t]
    kinds, messages = {t: BagFile(bag).topics[t].type for t in topics}, thinned(bag, topics)
    command = [sys.executable, "-m", "calib_ros.ros.process", "--ros-args", "-p", f"rig_file:={file}"]
    command += [word for value in given for word in ("-p", value)]
    rclpy.init()
    node, statuses, heard = rclpy.create_node("player"), dict[str, Any](), list[tuple[float, Rig]]()
    publishers = {t: node.create_publisher(message_class(kind), t, QoSProfile(depth=20)) for t, kind in kinds.items()}
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: statuses.update({s.name: s for s in m.status}), 50)
    node.create_subscription(Rig, "/calib_ros/rig", lambda m: heard.append((time.monotonic(), m)), LATCHED)
    with (folder / f"node_{cameras}.log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
    try:
        while not all(p.get_subscription_count() for p in publishers.values()):
            rclpy.spin_once(node, timeout_sec=0.1)
            if process.poll() is not None:
                raise SystemExit(f"the node ended; see {log.name}")
        began, playing = time.monotonic(), play(node, publishers, messages, seconds, dies)
        moments = [(now, cpu_s(process.pid), memory_mb(process.pid)) for now in playing]
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(30)
        rclpy.shutdown()
    ends = [moments[round(k * (len(moments) - 1) / 3)] for k in range(4)]
    thirds = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in pairwise(ends)]
    told = [{v.key: v.value for v in s.values} for name, s in statuses.items() if name.endswith(": extrinsic")]
    sums = [sum(int(v[key]) for v in told) for key in ("keyframes so far", "estimates accepted", "pairs")]
    dropped = sum(int(v["pairs dropped by a busy worker"]) for v in told)
    usable = f"{sum(s.usable for s in heard[-1][1].sensors)} of {len(sensors)}" if heard else "none"
    work = [sum(float(v[f"CPU for {kind.value}"]) for v in told) for kind in list(Work)[:5]]
    cpu, of_work, counts = " ".join(f"{h:.2f}" for h in thirds), " ".join(f"{w:.2f}" for w in work), ", ".join(map(str, sums))
    row = f"| {cameras} | {cpu} | {of_work} | {moments[-1][2]:.0f} | {counts} | {dropped} | {usable} |"
    return row, said(heard, began)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", default=DRIVE)
    parser.add_argument("--cameras", nargs="+", type=int, default=[1, 2, 6])
    parser.add_argument("--lidars", type=int, default=1)
    parser.add_argument("--dies", nargs=3, default=("", "0", "0"), metavar=("NAME", "FROM", "TO"))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--out", default="rig_load_out")
    parser.add_argument("-p", action="append", default=[], dest="given")
    args = parser.parse_args()
    own_network()
    folder = Path(args.out)
    folder.mkdir(parents=True, exist_ok=True)
    bag = folder / "bag"
    if not bag.exists():
        write_rig_bag(SyntheticRig.from_text(args.source), bag)
    dies = args.dies[0], float(args.dies[1]), float(args.dies[2])
    print(HEAD)
    told = []
    for cameras in args.cameras:
        row, lines = measure(bag, folder, cameras, args.lidars, args.seconds, args.given, dies)
        print(row, flush=True)
        told.append(f"{cameras} cameras\n{lines}")
    print("\n".join(told))


if __name__ == "__main__":
    main()

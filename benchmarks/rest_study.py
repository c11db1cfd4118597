"""What the node costs at rest, next to what ROS itself costs: a bare rclpy subscriber of the same topics, in the same run.

    python -m benchmarks.rest_study [SOURCE...] [--seconds 60] [--settle 45] [--parameters NAME:=VALUE...]

SOURCE: as for calib-ros; by default 64 rings with 0.5 Mpx, and 128 rings with 2 Mpx. Both processes are fed by the same
publishers at 10 Hz, the node from the right extrinsic; CPU time is counted from --settle on. It is that of the whole processes as
the kernel counts it: other work on the same cores does not matter much.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.fed_node import IMAGE, INFO, POINTS, RATE, cpu_s, fed_node, memory_mb, on_recording
from benchmarks.load_study import Watcher
from calib_ros.online.pacing import Work

SOURCES = (
    "synthetic:rig=pandar64_roof,frames=40,stride=1",
    "synthetic:rig=os1_128_windshield,width=1920,height=1208,frames=16,stride=1",
)
HEAD = f"""\
| source | CPU: bare, node, ratio | {", ".join(work.value for work in Work)} | keyframes, estimates a minute | callbacks, 99 % \
within, ms | MB: bare, node | ends |
|---|---|---|---|---|---|---|"""
BARE = f"""
import rclpy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from rclpy.qos import qos_profile_sensor_data
rclpy.init()
node = rclpy.create_node("bare")
for kind, topic in ((Image, "{IMAGE}"), (CameraInfo, "{INFO}"), (PointCloud2, "{POINTS}")):
    node.create_subscription(kind, topic, lambda msg: None, qos_profile_sensor_data)
try:
    rclpy.spin(node)
except BaseException:
    pass
"""


def measure(bag: Path, reference: Any, folder: Path, args: argparse.Namespace, name: str) -> None:
    """Feed both, and print a row."""
    bare = subprocess.Popen([sys.executable, "-c", BARE])
    try:
        with fed_node(bag, reference, folder, *args.parameters, draws=False) as fed:
            watcher, pids = Watcher(fed.client, fed.process.pid), (bare.pid, fed.process.pid)
            fed.run(int(args.settle * RATE), RATE)
            before, began, first = [cpu_s(pid) for pid in pids], time.monotonic(), watcher.moments[-1].values
            fed.run(int((args.settle + args.seconds) * RATE), RATE)
            seconds, last = time.monotonic() - began, watcher.moments[-1].values
            bare_cpu, node_cpu = ((cpu_s(pid) - start) / seconds for pid, start in zip(pids, before, strict=True))
            kinds = ", ".join(f"{float(last[f'CPU for {work.value}']):.3f}" for work in Work)  # of the last minute
            counts = [(int(last[k]) - int(first[k])) / seconds * 60 for k in ("keyframes so far", "estimates accepted")]
            cells = (
                name,
                f"{bare_cpu:.3f}, {node_cpu:.3f}, {node_cpu / bare_cpu:.2f}",
                kinds,
                f"{counts[0]:.0f}, {counts[1]:.0f}",
                last["callback 99th percentile, ms"],
                ", ".join(f"{memory_mb(pid):.0f}" for pid in pids),
                last["status"],
            )
            print(f"| {' | '.join(cells)} |", flush=True)
    finally:
        bare.send_signal(signal.SIGINT)
        bare.wait()


def main() -> int:
    """Feed, watch, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", default=SOURCES, help="as for calib-ros")
    parser.add_argument("--seconds", type=float, default=60.0, help="that are counted (default 60)")
    parser.add_argument("--settle", type=float, default=45.0, help="before them (default 45)")
    parser.add_argument("--parameters", nargs="*", default=[], metavar="NAME:=VALUE", help="more parameters of the node")
    parser.add_argument("--out", metavar="FOLDER", help="keep bags and node.log here; reuses the bags")
    args = parser.parse_args()
    print(HEAD, flush=True)
    return max(on_recording("rest_study", name, args.out, partial(measure, args=args, name=name)) for name in args.sources)


if __name__ == "__main__":
    sys.exit(main())

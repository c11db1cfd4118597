"""Node and player as processes of their own, as users run them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from calib_ros import se3
from calib_ros.ros.client import ExtrinsicClient

REMAP = ["-r", "image:=/camera/image_raw", "-r", "camera_info:=/camera/camera_info", "-r", "points:=/velodyne_points"]


@contextmanager
def node_process(*parameters: str, managed: bool = False) -> Iterator[subprocess.Popen[str]]:
    """The node, or the managed one, with parameters as "name:=value"."""
    command = [sys.executable, "-m", "calib_ros.ros.process", *["managed"] * managed, "--ros-args", *REMAP]
    for parameter in parameters:
        command += ["-p", parameter]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()
        process.stdout.close()


def initial(T: np.ndarray) -> list[str]:
    """Parameters of the initial extrinsic T."""
    t, q = T[:3, 3].tolist(), se3.quaternion_from_rotation(T[:3, :3]).tolist()
    return [f"initial_translation_m:={t}", f"initial_quaternion_xyzw:={q}"]


def play(bag: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "calib_ros", "play", str(bag), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def counts_of(client: ExtrinsicClient, at_least: int) -> dict[str, str]:
    """The node's counters from /diagnostics, once it has received so many images and clouds (or after 10 s)."""
    from diagnostic_msgs.msg import DiagnosticArray

    latest: dict[str, str] = {}

    def take(msg: DiagnosticArray) -> None:
        latest.update({v.key: v.value for v in msg.status[0].values})

    client._node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
    client.spin(10, lambda: int(latest.get("clouds", 0)) >= at_least and int(latest["images"]) >= at_least)
    return latest

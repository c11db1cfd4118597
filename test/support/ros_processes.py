"""Node and player as processes of their own, as users run them, and a client that waits as long as a busy machine takes."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calib_ros_msgs.action import Calibrate
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.action import ActionClient
from ros_peer import Goal
from waiting import LIMIT_S, until

from calib_ros import se3
from calib_ros.result import Result
from calib_ros.ros.client import ExtrinsicClient

REMAP = ["-r", "image:=/camera/image_raw", "-r", "camera_info:=/camera/camera_info", "-r", "points:=/velodyne_points"]
PATIENT = {"max_data_age_s": 3600.0, "semantics__segmentation": "none"}  # data do not grow too old on a busy machine


@contextmanager
def node_process(*parameters: str, managed: bool = False, program: str = "", **named: Any) -> Iterator[subprocess.Popen[str]]:
    """The node, the managed one, or a program; with parameters as "name:=value", or by their names with __ for the dot."""
    start = ["-c", program] if program else ["-m", "calib_ros.ros.process", *["managed"] * managed]
    command = [sys.executable, *start, "--ros-args", *REMAP]
    for name, value in {**PATIENT, **named}.items():
        command += ["-p", f"{name.replace('__', '.')}:={str(value).lower() if isinstance(value, bool) else value}"]
    for parameter in parameters:
        command += ["-p", parameter]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def end(node: subprocess.Popen[str], *numbers: int) -> str:
    """Send the signals, SIGINT without any; the node ends well. Returns what it has printed."""
    for number in numbers or [signal.SIGINT]:
        node.send_signal(number)
    text = node.communicate(timeout=LIMIT_S)[0]
    assert node.returncode == 0, text
    assert "Traceback" not in text, text
    return text


def initial(T: np.ndarray) -> list[str]:
    """Parameters of the initial extrinsic T."""
    t, q = T[:3, 3].tolist(), se3.quaternion_from_rotation(T[:3, :3]).tolist()
    return [f"initial_translation_m:={t}", f"initial_quaternion_xyzw:={q}"]


def play(bag: Path, *options: str) -> subprocess.Popen[str]:
    """The player; it waits long for the node to subscribe."""
    command = [sys.executable, "-X", "faulthandler", "-m", "calib_ros", "play", str(bag), "--wait", str(LIMIT_S / 2), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def played(bag: Path, *options: str) -> str:
    """Play a bag to its end, no faster than the node takes the images in. Returns what the player says."""
    player = play(bag, "--follow", "/calib_ros", *options)
    try:
        out, err = player.communicate(timeout=2 * LIMIT_S)
    except subprocess.TimeoutExpired:
        player.send_signal(signal.SIGABRT)  # shows where it hangs
        pytest.fail(f"the player does not end: {player.communicate()}")
    assert player.returncode == 0, err
    assert "Traceback" not in err, err
    assert "not heard" not in err, err
    return out


class Observer(ExtrinsicClient):
    """A client of the node that hears /diagnostics. values: the newest ones."""

    def __init__(self) -> None:
        super().__init__()
        self.values: dict[str, str] = {}
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)
        self._calibrate = ActionClient(self._node, Calibrate, "/calib_ros/calibrate")

    def _take(self, msg: DiagnosticArray) -> None:
        self.values = {v.key: v.value for v in msg.status[0].values}

    def count(self, name: str) -> float:
        return float(self.values.get(name, 0))

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Receive messages until the condition holds."""
        return until(condition, what, lambda: self.spin(0.1), lambda: self.values)

    def goal(self) -> Goal:
        """A goal of ~/calibrate that the node has answered."""
        return Goal(self._calibrate, self.until)

    def new_values(self) -> dict[str, str]:
        """Values that come after this call."""
        self.values = {}
        return self.until(lambda: self.values, "diagnostics")

    def get_extrinsic(self, timeout_s: float = LIMIT_S) -> tuple[bool, str, Result, float]:
        return super().get_extrinsic(timeout_s)

    def trigger(self, service: str, timeout_s: float = LIMIT_S) -> tuple[bool, str]:
        return super().trigger(service, timeout_s)

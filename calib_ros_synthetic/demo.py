"""`calib-ros demo`: the node on a built-in synthetic drive; bag, player and node are processes of their own."""

from __future__ import annotations

import dataclasses
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.cli.calibrate import draw, replay
from calib_ros.cli.inputs import configuration
from calib_ros.cli.output import page, progress_bar
from calib_ros.config import Config
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.overlay import write_png
from calib_ros.result import Extrinsic, Result
from calib_ros_synthetic.drive import SyntheticDrive

if TYPE_CHECKING:
    from calib_ros.ros.client import ExtrinsicClient

FRAMES = 60
STRIDE = 2  # every second scan of a 10 Hz sensor: the scenes spread over a street, and successive scans tell the velocity
PASSES = 5  # limit of the data: where the node has not converged after so many times the drive, the demo has failed
IDLE_S = 300.0  # without any frame taken in, after which the node hangs, on however busy a machine
STOP_S = 60.0  # longest wait for a process to end, on however busy a machine
GOAL_DEG, GOAL_M = 0.2, 0.05
LEFT_BEHIND = ("initial.json", "result.json", "state.json", "overlay.png", "overlay_from_node.png", "node.log", "player.log")
TOPICS = ("image:=/camera/image_raw", "camera_info:=/camera/camera_info", "points:=/velodyne_points")


def wrong_start(truth: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """`truth` (4, 4) moved by 2 to 2.8 deg and 15 to 22 cm in random directions."""
    rng = np.random.default_rng([seed, 1])
    axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    start = se3.perturb(truth, axis * rng.uniform(2.05, 2.8), np.zeros(3))
    start[:3, 3] = truth[:3, 3] + direction * rng.uniform(0.155, 0.22)
    return start


def run(out: str, seed: int, preset: str = "", gif: str | None = None) -> bool:
    """Run the demo and leave everything in the folder `out`; True if the extrinsic was recovered to 0.2 deg and 5 cm. preset: of
    the node. gif: file for a moving picture of the drive, by a replay of the bag."""
    from calib_ros.ros.client import ExtrinsicClient
    from calib_ros.ros.distributions import on_this_machine_only

    write_film, drive = page("gif", gif), SyntheticDrive(seed, FRAMES, stride=STRIDE)
    folder = _fresh_folder(Path(out))
    for number in (signal.SIGTERM, signal.SIGHUP):  # end like Ctrl-C, so that node and player do not outlive us
        signal.signal(number, signal.default_int_handler)
    start = wrong_start(drive.reference, seed)
    print(f"writing the bag {folder / 'bag'}: {FRAMES} frames of a synthetic street", flush=True)
    with progress_bar("rendering") as step:
        write_bag(drive, folder / "bag", "mcap", progress=step)
    initial = Result(start, "initial", "wrong on purpose", camera_frame=drive.camera_frame, lidar_frame=drive.lidar_frame)
    initial.save(folder / "initial.json")
    domain = random.SystemRandom().randrange(1, 101)  # so that a demo beside a running system does not meet it
    os.environ.update({**on_this_machine_only(), "ROS_DOMAIN_ID": str(domain)})
    print(f"starting node and player as processes on ROS domain {domain}", flush=True)
    goal = f"an extrinsic that the node calls converged, within {GOAL_DEG} deg and {100 * GOAL_M:g} cm of the truth"
    print(f"goal: {goal}", flush=True)
    with (
        _Process("node", _node_command(start, folder, preset), folder / "node.log") as node,
        ExtrinsicClient(domain_id=domain) as client,
    ):
        client.get_extrinsic(timeout_s=IDLE_S)  # the node is up
        play = [sys.executable, "-m", "calib_ros", "play", str(folder / "bag"), "--loop", "--follow", "/calib_ros"]
        with _Process("player", play, folder / "player.log") as player:
            result, drift = _drive(client, node, player)
        node.must_stop()
    recovered = _report(folder, drive, start, result, drift, client)
    if write_film is not None:
        given = str(folder / "initial.json"), 0.0, configuration(None, preset_name=preset), write_film
        deque(replay(open_dataset(folder / "bag"), "all", *given), maxlen=0)
    return recovered


def _drive(client: ExtrinsicClient, node: _Process, player: _Process) -> tuple[Result, float]:
    """Play until the node's extrinsic has converged, or to the limit of the data; what its service says then, and the drift.

    The player waits for the node, so that what the node has seen by then does not depend on how fast the machine is.
    """
    limit, seen, since = PASSES * FRAMES, 0, time.monotonic()
    with progress_bar("driving") as step:
        while True:
            client.spin(0.5)
            node.must_run()
            player.must_run()
            _, _, result, drift = client.get_extrinsic(timeout_s=IDLE_S)
            step(min(client.frames / limit, 1.0))
            if (result.converged and client.overlay is not None) or client.frames >= limit:
                return result, drift
            if client.frames > seen:
                seen, since = client.frames, time.monotonic()
            elif time.monotonic() - since > IDLE_S:
                raise CalibrationError(f"the node has taken in no frame for {IDLE_S:g} s; see {node.log}")


def _report(
    folder: Path, drive: SyntheticDrive, start: NDArray[np.float64], result: Result, drift: float, client: ExtrinsicClient
) -> bool:
    truth, overlay = drive.reference, client.overlay
    before = se3.rotation_error_deg(truth, start), se3.translation_error_m(truth, start)
    after = se3.rotation_error_deg(truth, result.T_camera_lidar), se3.translation_error_m(truth, result.T_camera_lidar)
    result = dataclasses.replace(result, reference_error=after, initial=start)
    result.save(folder / "result.json")
    if overlay is not None:
        write_png(folder / "overlay_from_node.png", overlay)
    draw(folder / "overlay.png", drive[FRAMES // 2], Extrinsic(result, drift), Config())
    print(f"start    {before[0]:.3f} deg  {100 * before[1]:.2f} cm  from the truth")
    print(f"answer   {after[0]:.3f} deg  {100 * after[1]:.2f} cm  from the truth")
    print(f"{result.status}: {result.frames_used} keyframes, score {result.score:.3f}")
    print(f"overlays received over ROS: {client.overlays}")
    print(f"left in {folder}: bag/ {' '.join(LEFT_BEHIND)}")
    recovered = result.converged and after[0] <= GOAL_DEG and after[1] <= GOAL_M and overlay is not None
    verdict = "recovered" if recovered else f"not recovered; see {folder / 'node.log'}"
    print(f"{verdict}: the goal was converged, {GOAL_DEG} deg and {100 * GOAL_M:g} cm, and an overlay over ROS")
    return recovered


def _node_command(start: NDArray[np.float64], folder: Path, preset: str) -> list[str]:
    numbers = [",".join(f"{v:.9f}" for v in values) for values in (start[:3, 3], se3.quaternion_from_rotation(start[:3, :3]))]
    command = [sys.executable, "-m", "calib_ros.ros.process", "--ros-args"]
    for topic in TOPICS:
        command += ["-r", topic]
    for parameter in (
        f"initial_translation_m:=[{numbers[0]}]",
        f"initial_quaternion_xyzw:=[{numbers[1]}]",
        f"state_file:={folder / 'state.json'}",
        "overlay_period_s:=0.0",  # one for every frame: they are counted
        *([f"preset:={preset}"] if preset else []),
    ):
        command += ["-p", parameter]
    return command


def _fresh_folder(folder: Path) -> Path:
    """Make the folder, or clear it of what an earlier demo left. BadInputError if files of these names are somebody else's."""
    folder = folder.resolve()
    marker = folder / ".calib_ros_demo"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        ours = ("bag", *LEFT_BEHIND)
        if foreign := [name for name in ours if (folder / name).exists() and not marker.exists()]:
            raise BadInputError(f"{folder} holds {foreign[0]}, which no demo made; choose another --out")
        shutil.rmtree(folder / "bag", ignore_errors=True)
        for name in LEFT_BEHIND:
            (folder / name).unlink(missing_ok=True)
        marker.touch()
    except OSError as error:
        raise BadInputError(f"cannot use the folder {folder}: {error.strerror}; choose another --out") from None
    return folder


class _Process(subprocess.Popen[bytes]):
    """A child process with a log file; stopped by SIGINT when the block ends."""

    def __init__(self, name: str, command: Sequence[str], log: Path) -> None:
        self.name, self.log = name, log
        with log.open("wb") as file:
            super().__init__(command, stdout=file, stderr=subprocess.STDOUT)

    def __exit__(self, *what: object) -> None:
        with suppress(CalibrationError):
            self.must_stop()
        self.kill()
        self.wait()

    def must_run(self) -> None:
        """CalibrationError with the end of the log if the process has ended."""
        if self.poll() is not None:
            raise self._failed(f"ended with code {self.returncode}")

    def must_stop(self) -> None:
        """Stop by SIGINT; CalibrationError if it does not end well within STOP_S."""
        self.send_signal(signal.SIGINT)
        try:
            code = self.wait(STOP_S)
        except subprocess.TimeoutExpired:
            raise self._failed("does not stop on SIGINT") from None
        if code != 0:
            raise self._failed(f"ended with code {code} on SIGINT")

    def _failed(self, what: str) -> CalibrationError:
        tail = " | ".join(self.log.read_text(errors="replace").strip().splitlines()[-3:])
        return CalibrationError(f"the {self.name} {what}; its log {self.log} ends: {tail}")

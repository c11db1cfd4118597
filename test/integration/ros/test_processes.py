"""Node and player as processes of their own, as users run them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from calib_ros_msgs.action import Calibrate
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionClient
from ros_processes import counts_of, initial, node_process, play
from vehicle import QUICK

from calib_ros import se3
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.result import Result
from calib_ros.ros.client import ExtrinsicClient
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = pytest.mark.ros
SMALL_SEARCH = [f"{name.replace('__', '.')}:={value}" for name, value in QUICK.items() if name.startswith("search")]
PROMPT_S = 20  # far less than the work that the node breaks off; generous, so that a busy machine does not fail it


def last_extrinsic(client: ExtrinsicClient, quiet_s: float = 3.0) -> Result:
    """The current extrinsic once no estimate has changed it for a while."""
    last, since = client.get_extrinsic()[2], time.monotonic()
    while time.monotonic() - since < quiet_s:
        client.spin(0.5, lambda: False)
        new = client.get_extrinsic()[2]
        if not np.array_equal(new.T_camera_lidar, last.T_camera_lidar):
            last, since = new, time.monotonic()
    return last


def test_bag_played_into_the_node(street_bag: Path, drive: SyntheticDrive, tmp_path: Path) -> None:
    start = se3.perturb(drive.reference, [1.0, -1.5, 0.5], [0.05, 0.08, -0.05])
    parameters = (
        *initial(start),
        *SMALL_SEARCH,
        f"state_file:={tmp_path / 'state.json'}",
        "tracker.confirmations:=0",
        "online.rest_period_s:=0.0",
    )
    with node_process(*parameters) as node, ExtrinsicClient() as client:
        client.get_extrinsic(30)
        player = play(street_bag, "--rate", "4")
        out, err = player.communicate(timeout=60)
        assert player.returncode == 0, err
        assert "Traceback" not in err
        played = {line.split()[1]: int(line.split()[0]) for line in out.splitlines()}
        assert played == {"/camera/camera_info": 8, "/camera/image_raw": 8, "/tf_static": 1, "/velodyne_points": 8}
        client.spin(20, lambda: client.get_extrinsic()[2].frames_used >= 7)
        success, message, result, _ = client.get_extrinsic()
        assert success, message
        assert se3.rotation_error_deg(drive.reference, result.T_camera_lidar) < 0.3
        assert se3.translation_error_m(drive.reference, result.T_camera_lidar) < 0.08
        client.spin(3, lambda: client.overlays > 0)
        assert client.overlays > 0
        seen = counts_of(client, 8)
        assert (seen["images"], seen["clouds"]) == ("8", "8")
        result = last_extrinsic(client)  # later keyframes, and their semantics, may have given another estimate meanwhile
        node.send_signal(signal.SIGINT)
        assert node.wait(PROMPT_S) == 0
        assert "Traceback" not in node.stdout.read()
    np.testing.assert_allclose(
        json.loads((tmp_path / "state.json").read_text())["T_camera_lidar"], result.T_camera_lidar, atol=1e-9
    )


def test_a_player_that_follows_the_node_loses_no_pair(street_bag: Path, drive: SyntheticDrive) -> None:
    """Played ten times as fast as recorded, which no node keeps up with, every pair is taken in nevertheless."""
    quick = ("overlay_period_s:=0.0", "search.starts:=512", "semantics.segmentation:=none")
    with node_process(*initial(drive.reference), *quick) as node, ExtrinsicClient() as client:
        client.get_extrinsic(30)
        player = play(street_bag, "--rate", "10", "--follow", "/calib_ros")
        out, err = player.communicate(timeout=200)
        assert player.returncode == 0, err
        assert "8  /camera/image_raw" in out
        seen = counts_of(client, 8)
        assert (seen["pairs"], seen["pairs dropped by a busy worker"]) == ("8", "0")
        node.send_signal(signal.SIGINT)
        assert node.wait(PROMPT_S) == 0


@pytest.mark.slow
def test_a_looping_bag_with_its_clock(street_bag: Path, drive: SyntheticDrive) -> None:
    """Stamps and /clock jump back at the end of every loop: keyframes, estimates and diagnostics go on, nothing is forgotten."""
    start = se3.perturb(drive.reference, [0.8, -0.6, 0.5], [0.04, 0.05, -0.05])
    quick = ("online.min_keyframes:=4", "search.starts:=512", "semantics.segmentation:=none")
    with node_process(*initial(start), "use_sim_time:=true", *quick) as node, ExtrinsicClient() as client:
        client.get_extrinsic(30)
        player = play(street_bag, "--rate", "6", "--loop", "--clock")
        first = dict(counts_of(client, 12))  # it goes on changing
        later = dict(counts_of(client, int(first["clouds"]) + 24))
        player.send_signal(signal.SIGINT)
        _, err = player.communicate(timeout=20)
        assert player.returncode == 0, err
        assert "Traceback" not in err
        client.spin(20, lambda: client.get_extrinsic()[0])
        success, message, result, _ = client.get_extrinsic()
        assert success, message
        assert se3.rotation_error_deg(drive.reference, result.T_camera_lidar) < 0.3
        assert se3.translation_error_m(drive.reference, result.T_camera_lidar) < 0.08
        assert int(later["stamps jumped back"]) >= 3
        assert int(later["keyframes so far"]) > int(first["keyframes so far"])
        assert int(later["estimates accepted"]) >= int(first["estimates accepted"])
        assert int(later["pairs"]) >= 0.8 * int(later["images"])
        node.send_signal(signal.SIGINT)
        assert node.wait(PROMPT_S) == 0
        text = node.stdout.read()
    assert "Traceback" not in text
    assert "jumped back" in text


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_signal_during_an_estimate(street_bag: Path, drive: SyntheticDrive, tmp_path: Path, number: signal.Signals) -> None:
    """The requested search takes minutes; the node still ends at once, and the saved state stays whole."""
    state = tmp_path / "state.json"
    saved = {
        "T_camera_lidar": drive.reference.tolist(),
        "camera_frame": "camera",
        "lidar_frame": "velodyne",
        "status": "converged",
    }
    state.write_text(json.dumps(saved))
    parameters = ("search.starts:=1048576", "online.min_keyframes:=1", "semantics.segmentation:=none", f"state_file:={state}")
    with node_process(*parameters) as node, ExtrinsicClient() as client:
        client.get_extrinsic(30)
        player = play(street_bag, "--rate", "8")
        player.communicate(timeout=60)
        busy: dict[str, str] = {}
        for _ in range(6):  # a starved machine may take long to tell
            busy = counts_of(client, 8)
            if int(busy.get("keyframes so far", 0)) > 0 and float(busy["worker load"]) > 0.5:
                break
        assert int(busy["keyframes so far"]) > 0
        assert float(busy["worker load"]) > 0.5
        assert busy["estimates accepted"] == "0"
        node.send_signal(number)
        code = node.wait(PROMPT_S)
        text = node.stdout.read()
    assert code == 0, text
    assert "Traceback" not in text
    assert json.loads(state.read_text()) == saved


@pytest.mark.parametrize(
    ("managed", "numbers"),
    [
        # launch and shell both send SIGINT: the second one comes while the node is ending
        (True, [signal.SIGINT, signal.SIGINT]),
        pytest.param(True, [signal.SIGTERM], marks=pytest.mark.slow),
        pytest.param(False, [signal.SIGINT, signal.SIGINT], marks=pytest.mark.slow),
        pytest.param(False, [signal.SIGTERM, signal.SIGINT], marks=pytest.mark.slow),
    ],
)
def test_signals_during_a_goal(street_bag: Path, managed: bool, numbers: list[signal.Signals]) -> None:
    parameters = ("search.starts:=1048576", "online.mode:=manual", "semantics.segmentation:=none", "initial_from_tf:=false")
    with node_process(*parameters, managed=managed) as node, ExtrinsicClient() as client:
        if managed:
            change = client._node.create_client(ChangeState, "/calib_ros/change_state")
            for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
                assert client._call(change, ChangeState.Request(transition=Transition(id=transition)), 30).success
        client.get_extrinsic(30)
        play(street_bag, "--rate", "8").communicate(timeout=60)
        action, feedback = ActionClient(client._node, Calibrate, "/calib_ros/calibrate"), []
        assert action.wait_for_server(10)
        action.send_goal_async(Calibrate.Goal(), feedback_callback=feedback.append)
        assert client.spin(30, lambda: bool(feedback))
        for number in numbers:
            node.send_signal(number)
        code = node.wait(PROMPT_S)
        text = node.stdout.read()
    assert code == 0, text
    assert "Traceback" not in text
    assert "unexpected" not in text


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("entry_point", ["calib_node", "calib_lifecycle_node"])
def test_a_signal_while_the_libraries_are_imported(entry_point: str, number: signal.Signals) -> None:
    program = f"""
import os, sys
from calib_ros.ros.process import {entry_point}
class Signal:
    def find_spec(self, name, path, target=None):
        if name == "rclpy":
            os.kill(os.getpid(), {int(number)})
sys.meta_path.insert(0, Signal())
sys.exit({entry_point}() + 3)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_sigint_during_a_long_estimate_of_the_thesis_objective(street_bag: Path, drive: SyntheticDrive) -> None:
    """Eight smoothings of eq. 3.12 over three frames take far longer than PROMPT_S; the node still ends at once."""
    parameters = (
        "refine.objective:=thesis",
        "thesis.smoothing:=[16.0, 12.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.0]",
        "thesis.evaluations:=100000",
        "search.rotation_deg:=0.0",
        "search.translation_m:=0.0",
        "online.min_keyframes:=3",
        "semantics.segmentation:=none",
    )
    with (
        node_process(*initial(se3.perturb(drive.reference, [0.5, -0.4, 0.3], [0.03, -0.02, 0.03])), *parameters) as node,
        ExtrinsicClient() as client,
    ):
        client.get_extrinsic(30)
        play(street_bag, "--rate", "2").communicate(timeout=60)
        busy = counts_of(client, 8)
        client.spin(3.0, lambda: False)
        assert int(busy["keyframes so far"]) >= 3
        node.send_signal(signal.SIGINT)
        code = node.wait(PROMPT_S)
        text = node.stdout.read()
    assert code == 0, text
    assert "Traceback" not in text
    assert "extrinsic from" not in text, "the estimate was over before the signal came"
    assert "refused" not in text


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["-p", "search.rotation_deg:=-5.0"], "search.rotation_deg"),
        (["--params-file", "{bad}"], "bad.yaml"),
        (["--params-file", "/nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_a_node_that_cannot_start_says_why_in_one_line(tmp_path: Path, arguments: list[str], text: str) -> None:
    (tmp_path / "bad.yaml").write_text("/**:\n  ros__parameters:\n    search.seed: [1, 2\n")
    arguments = [a.format(bad=tmp_path / "bad.yaml") for a in arguments]
    done = subprocess.run(
        [sys.executable, "-m", "calib_ros.ros.process", "--ros-args", *arguments], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if "[WARN]" not in line]
    assert len(lines) == 1, done.stderr
    assert text in lines[0]


def test_player_refuses_paths_without_a_bag(tmp_path: Path) -> None:
    for path in (tmp_path / "missing", tmp_path):
        player = play(path)
        _, err = player.communicate(timeout=30)
        assert player.returncode == 2
        assert len(err.splitlines()) == 1
        assert str(path) in err


def played(bag: Path, client: ExtrinsicClient) -> None:
    """The whole bag once, while the client listens."""
    with play(bag) as player:
        while player.poll() is None:
            client.spin(0.2)
        assert player.returncode == 0, player.stderr.read()


@pytest.mark.slow
@pytest.mark.kitti
def test_kitti_drive_played_at_10_hz(kitti_root: Path, tmp_path: Path) -> None:
    """All images and clouds arrive, the service's answer is within 0.35 deg and 10 cm, an overlay comes."""
    source = open_dataset(kitti_root / "raw/2011_09_26/2011_09_26_drive_0005_sync")
    bag = write_bag(source, tmp_path / "bag", "mcap")
    start = se3.perturb(source.reference, [1.2, -1.0, 0.7], [0.1, -0.1, 0.05])
    # The scanner triggers the camera; the few keyframes of a busy machine need not show it.
    with node_process(*initial(start), "motion.max_time_offset_s:=0.0") as node, ExtrinsicClient() as client:
        client.get_extrinsic(30)
        played(bag, client)
        seen = counts_of(client, len(source))
        assert (seen["images"], seen["clouds"]) == ("29", "29")
        # A busy machine takes too few keyframes of a drive of three seconds; it passes again then.
        for _ in range(3):
            client.spin(3)
            if client.get_extrinsic()[0]:
                break
            played(bag, client)
        client.spin(30, lambda: client.get_extrinsic()[0])
        success, message, result, _ = client.get_extrinsic()
        assert success, message
        assert se3.rotation_error_deg(source.reference, result.T_camera_lidar) < 0.35
        assert se3.translation_error_m(source.reference, result.T_camera_lidar) < 0.10
        assert client.overlays > 0
        node.send_signal(signal.SIGTERM)
        assert node.wait(PROMPT_S) == 0

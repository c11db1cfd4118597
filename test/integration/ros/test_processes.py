"""Node and player as processes of their own, as users run them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from ros_processes import Observer, end, initial, node_process, play, played
from vehicle import QUICK
from waiting import LIMIT_S

from calib_ros import se3
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.result import CONVERGED, Result

pytestmark = pytest.mark.ros
SMALL_SEARCH = {name: value for name, value in QUICK.items() if name.startswith("search")}
LONG_SEARCH = {"search__starts": 1 << 20}  # minutes


def assert_found(client: Observer, reference: np.ndarray, deg: float = 0.3, m: float = 0.08) -> None:
    """The node answers with the right extrinsic, at the latest when it has worked off what it has received."""
    client.until(lambda: client.get_extrinsic()[0], "an extrinsic")
    T = client.get_extrinsic()[2].T_camera_lidar
    assert se3.rotation_error_deg(reference, T) < deg
    assert se3.translation_error_m(reference, T) < m


def assert_broken_off(text: str) -> None:
    """The node has ended before its estimate did."""
    assert not any(said in text for said in ("extrinsic from", "estimate refused", "unexpected")), text


def test_bag_played_into_the_node(street_bag, drive, tmp_path):
    state, start = tmp_path / "state.json", se3.perturb(drive.reference, [1.0, -1.5, 0.5], [0.05, 0.08, -0.05])
    quick = {"tracker__confirmations": 0, "online__rest_period_s": 0.0, "semantics__segmentation": "auto"}
    with node_process(*initial(start), state_file=state, **SMALL_SEARCH, **quick) as node, Observer() as client:
        out = played(street_bag, "--rate", "4")
        counts = {line.split()[1]: int(line.split()[0]) for line in out.splitlines()}
        assert counts == {"/camera/camera_info": 8, "/camera/image_raw": 8, "/tf_static": 1, "/velodyne_points": 8}
        client.until(lambda: client.count("images") == client.count("clouds") == 8, "all images and clouds")
        client.until(lambda: client.get_extrinsic()[2].frames_used >= 7, "an estimate over the whole bag")
        assert_found(client, drive.reference)
        assert client.overlays > 0
        current = lambda: client.get_extrinsic()[2].T_camera_lidar  # noqa: E731
        # Classes of later keyframes may give another estimate meanwhile.
        saved = lambda: np.array(json.loads(state.read_text())["T_camera_lidar"])  # noqa: E731
        client.until(lambda: np.allclose(saved(), current(), atol=1e-9), "that the current extrinsic is saved")
        end(node)


def test_a_player_that_follows_the_node_loses_no_pair(street_bag, drive):
    """Played ten times as fast as recorded, which no node keeps up with, every pair is taken in nevertheless."""
    with node_process(*initial(drive.reference), search__starts=512) as node, Observer() as client:
        assert "8  /camera/image_raw" in played(street_bag, "--rate", "10")
        client.until(lambda: client.count("pairs") == 8, "all pairs")
        assert client.new_values()["pairs dropped by a busy worker"] == "0"
        end(node)


@pytest.mark.slow
def test_a_looping_bag_with_its_clock(street_bag, drive):
    """Stamps and /clock jump back at the end of every loop: keyframes, estimates and diagnostics go on, nothing is forgotten."""
    start = se3.perturb(drive.reference, [0.8, -0.6, 0.5], [0.04, 0.05, -0.05])
    quick = {"online__min_keyframes": 4, "search__starts": 512, "use_sim_time": True}
    with node_process(*initial(start), **quick) as node, Observer() as client:
        player = play(street_bag, "--rate", "6", "--loop", "--clock", "--follow", "/calib_ros")
        client.until(lambda: client.count("clouds") >= 12, "a lap and a half")
        first = dict(client.values)
        client.until(lambda: client.count("stamps jumped back") >= 4, "four laps")
        assert_found(client, drive.reference)
        later = client.new_values()
        player.send_signal(signal.SIGINT)
        _, err = player.communicate(timeout=LIMIT_S)
        assert player.returncode == 0, err
        assert "Traceback" not in err
        assert int(later["keyframes so far"]) > int(first["keyframes so far"])
        assert int(later["estimates accepted"]) >= int(first["estimates accepted"])
        assert int(later["pairs"]) >= 0.8 * int(later["images"])
        assert "jumped back" in end(node)


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_signal_during_an_estimate(street_bag, drive, tmp_path, number):
    """The search takes minutes; the node ends without it, and the saved state stays whole."""
    state = tmp_path / "state.json"
    Result(drive.reference, CONVERGED, camera_frame="camera", lidar_frame="velodyne").save(state)
    saved = state.read_bytes()
    with node_process(**LONG_SEARCH, online__min_keyframes=1, state_file=state) as node, Observer() as client:
        played(street_bag, "--rate", "8")
        client.until(lambda: client.count("estimate load") > 0.5, "an estimate under way")
        assert client.count("keyframes so far") > 0
        assert client.count("estimates accepted") == 0
        assert_broken_off(end(node, number))
    assert state.read_bytes() == saved


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
def test_signals_during_a_goal(street_bag, managed, numbers):
    manual = {"online__mode": "manual", "initial_from_tf": False}
    with node_process(managed=managed, **LONG_SEARCH, **manual) as node, Observer() as client:
        if managed:
            change = client._node.create_client(ChangeState, "/calib_ros/change_state")
            for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
                assert client._call(change, ChangeState.Request(transition=Transition(id=transition)), LIMIT_S).success
        played(street_bag, "--rate", "8")
        client.goal().await_feedback()
        assert_broken_off(end(node, *numbers))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("entry_point", ["calib_node", "calib_lifecycle_node"])
def test_a_signal_while_the_libraries_are_imported(entry_point, number):
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
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=LIMIT_S)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_sigint_during_a_long_estimate_of_the_thesis_objective(street_bag, drive):
    """Eight smoothings of eq. 3.12 over three frames take minutes; the node ends without them."""
    long = {
        "refine__objective": "thesis",
        "thesis__smoothing": [16.0, 12.0, 8.0, 6.0, 4.0, 3.0, 2.0, 1.0],
        "thesis__evaluations": 100000,
        "search__rotation_deg": 0.0,
        "search__translation_m": 0.0,
        "online__min_keyframes": 3,
    }
    start = se3.perturb(drive.reference, [0.5, -0.4, 0.3], [0.03, -0.02, 0.03])
    with node_process(*initial(start), **long) as node, Observer() as client:
        played(street_bag, "--rate", "2")
        client.until(lambda: client.count("estimate load") > 0.5, "an estimate under way")
        assert_broken_off(end(node))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["-p", "search.rotation_deg:=-5.0"], "search.rotation_deg"),
        (["--params-file", "{bad}"], "bad.yaml"),
        (["--params-file", "/nowhere.yaml"], "nowhere.yaml"),
    ],
)
def test_a_node_that_cannot_start_says_why_in_one_line(tmp_path, arguments, text):
    (tmp_path / "bad.yaml").write_text("/**:\n  ros__parameters:\n    search.seed: [1, 2\n")
    command = [sys.executable, "-m", "calib_ros.ros.process", "--ros-args"]
    command += [argument.format(bad=tmp_path / "bad.yaml") for argument in arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if "[WARN]" not in line]
    assert len(lines) == 1, done.stderr
    assert text in lines[0]


def test_a_player_says_where_it_follows_nobody(street_bag):
    player = play(street_bag, "--follow", "/nobody", "--wait", "0.2", "--rate", "50")
    _, err = player.communicate(timeout=LIMIT_S)
    assert player.returncode == 0, err
    assert "/nobody is not heard" in err


def test_player_refuses_paths_without_a_bag(tmp_path):
    for path in (tmp_path / "missing", tmp_path):
        player = play(path)
        _, err = player.communicate(timeout=LIMIT_S)
        assert player.returncode == 2
        assert len(err.splitlines()) == 1
        assert str(path) in err


@pytest.mark.slow
@pytest.mark.kitti
def test_a_kitti_drive_played_into_the_node(kitti_root, tmp_path):
    """All images and clouds arrive, the service's answer is soon within 0.35 deg and 10 cm, an overlay comes."""
    source = open_dataset(kitti_root / "raw/2011_09_26/2011_09_26_drive_0005_sync")
    bag = write_bag(source, tmp_path / "bag", "mcap")
    start = se3.perturb(source.reference, [1.2, -1.0, 0.7], [0.1, -0.1, 0.05])
    # The scanner triggers the camera; three seconds of a drive need not show it.
    known = {"motion__max_time_offset_s": 0.0, "online__max_load": 1.0, "semantics__segmentation": "auto"}
    with node_process(*initial(start), **known) as node, Observer() as client:
        played(bag)
        client.until(lambda: client.count("images") == client.count("clouds") == 29, "all images and clouds")
        client.until(lambda: client.count("estimates accepted") >= 1, "an extrinsic")
        # Whether the last keyframes, a second apart, make the monitor doubt it depends on which estimates there was time for.
        T = client.get_extrinsic()[2].T_camera_lidar
        assert se3.rotation_error_deg(source.reference, T) < 0.35
        assert se3.translation_error_m(source.reference, T) < 0.10
        assert client.overlays > 0
        end(node, signal.SIGTERM)

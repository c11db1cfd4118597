"""Node and player as processes of their own, as users run them."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from ros_processes import Observer, end, initial, node_process, play, played
from scenes import is_near
from sensor_msgs.msg import Image, PointCloud2
from vehicle import CLOSE_DEG, CLOSE_M, QUICK, off
from waiting import LIMIT_S

from calib_ros import se3
from calib_ros.datasets import open_dataset
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.result import CONVERGED, Result

pytestmark = pytest.mark.ros
SMALL_SEARCH = {name: value for name, value in QUICK.items() if name.startswith("search")}
LONG_SEARCH = {"search__starts": 1 << 20}  # minutes


def ran(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A process of Python that has ended."""
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=LIMIT_S)


def assert_kept(client: Observer, reference: np.ndarray) -> None:
    """The node answers with the right extrinsic."""
    success, message, result, _ = client.get_extrinsic()
    assert success, message
    assert is_near(reference, result.T_camera_lidar, CLOSE_DEG, CLOSE_M)


def assert_found(client: Observer, reference: np.ndarray) -> None:
    """At the latest when it has worked off what it has received."""
    client.until(lambda: client.get_extrinsic()[0], "an extrinsic")
    assert_kept(client, reference)


def assert_recovers(client: Observer, reference: np.ndarray) -> None:
    """More pairs come, and another estimate is accepted."""
    client.new_values()
    pairs, accepted = client.count("pairs"), client.count("estimates accepted")
    client.until(lambda: client.count("pairs") > pairs and client.count("estimates accepted") > accepted, "another estimate")
    assert_kept(client, reference)


@contextmanager
def playing(bag: Path) -> Iterator[None]:
    """A player that runs until it is killed, hard."""
    player = play(bag, "--rate", "4", "--loop")
    try:
        yield
    finally:
        player.kill()
        player.communicate()


def assert_broken_off(text: str) -> None:
    """The node has ended before its estimate did."""
    assert not any(said in text for said in ("extrinsic from", "estimate refused", "unexpected")), text


def test_bag_played_into_the_node(street_bag, drive, tmp_path):
    """Every pair is taken in, and gives an extrinsic."""
    state, start = tmp_path / "state.json", off(drive.reference)
    quick = {"tracker__confirmations": 0, "online__rest_period_s": 0.0, "semantics__segmentation": "auto"}
    with node_process(*initial(start), state_file=state, **SMALL_SEARCH, **quick) as node, Observer() as client:
        out = played(street_bag, "--rate", "10")  # ten times as fast as recorded, but as the node can take it
        counts = {line.split()[1]: int(line.split()[0]) for line in out.splitlines()}
        assert counts == {"/camera/camera_info": 8, "/camera/image_raw": 8, "/tf_static": 1, "/velodyne_points": 8}
        client.until(lambda: client.count("images") == client.count("clouds") == client.count("pairs") == 8, "all pairs")
        assert client.new_values()["pairs dropped by a busy worker"] == "0"
        client.until(lambda: client.get_extrinsic()[2].frames_used >= 7, "an estimate over the whole bag")
        assert_found(client, drive.reference)
        client.until(lambda: client.overlays > 0, "an overlay, though the bag may have ended before anyone listened to it")

        def is_saved() -> bool:
            """Classes of later keyframes may give another estimate meanwhile."""
            saved, current = json.loads(state.read_text())["T_camera_lidar"], client.get_extrinsic()[2].T_camera_lidar
            return np.allclose(saved, current, atol=1e-9)

        client.until(is_saved, "that the current extrinsic is saved")
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
        assert all(int(later[what]) > int(first[what]) for what in ("pairs", "keyframes so far"))
        assert "jumped back" in end(node)


def test_signal_during_an_estimate(street_bag, drive, tmp_path):
    """The node ends without it, and the saved state stays whole."""
    state = tmp_path / "state.json"
    Result(drive.reference, CONVERGED, camera_frame="camera", lidar_frame="velodyne").save(state)
    saved = state.read_bytes()
    with node_process(**LONG_SEARCH, online__min_keyframes=1, state_file=state) as node, Observer() as client:
        played(street_bag, "--rate", "8")
        client.until(lambda: client.count("estimate load") > 0.5, "an estimate under way")
        assert client.count("keyframes so far") > 0
        assert client.count("estimates accepted") == 0
        assert_broken_off(end(node))
    assert state.read_bytes() == saved


@pytest.mark.parametrize(
    ("managed", "numbers"),
    [
        # launch and shell both send SIGINT: the second one comes while the node is ending
        (True, [signal.SIGINT, signal.SIGINT]),
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


@pytest.mark.slow
def test_a_publisher_is_killed_and_comes_back(street_bag, drive):
    """In the middle of its messages; between the two others publish the wrong types on the topics."""
    start = initial(off(drive.reference))
    with node_process(*start, **QUICK) as node, Observer() as client:
        with playing(street_bag):
            client.until(lambda: client.count("estimates accepted") > 1, "an estimate")
            assert_recovers(client, drive.reference)
        assert_kept(client, drive.reference)
        topics = {"/camera/image_raw": PointCloud2, "/velodyne_points": Image, "/camera/camera_info": Image}
        swapped = [client._node.create_publisher(kind, topic, 10) for topic, kind in topics.items()]

        def disturb() -> None:
            for publisher in swapped:
                publisher.publish(publisher.msg_type())
            client.spin(0.02)

        for _ in range(20):
            disturb()
        assert_kept(client, drive.reference)
        with playing(street_bag):
            assert_recovers(client, drive.reference)
            disturb()  # beside the right ones
            assert_recovers(client, drive.reference)
        assert_kept(client, drive.reference)
        end(node)


@pytest.mark.slow
def test_killed_node_restarts_with_the_last_good_extrinsic(street_bag, drive, tmp_path):
    """SIGKILL at any moment leaves a whole state file. The next node answers with it before the first image."""
    state = tmp_path / "state.json"
    settings = {**QUICK, "state_file": state}
    with node_process(*initial(off(drive.reference)), **settings) as node, Observer() as client, playing(street_bag):
        client.until(lambda: client.count("estimates accepted") > 1, "an estimate")
        node.kill()
        node.wait()
    assert [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")] == [state.name]
    saved = json.loads(state.read_text())
    assert saved["status"] == "converged"
    with node_process(**settings), Observer() as client:
        _, message, result, _ = client.get_extrinsic()
        assert message
        np.testing.assert_allclose(result.T_camera_lidar, saved["T_camera_lidar"], atol=1e-9)
        with playing(street_bag):
            assert_found(client, drive.reference)  # keyframes confirm what was saved


@pytest.mark.parametrize(("entry_point", "number"), [("calib_node", signal.SIGINT), ("calib_lifecycle_node", signal.SIGTERM)])
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
    done = ran("-c", program)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("entry_point", "module", "owner", "name"),
    [
        ("calib_node", "rclpy.node", "Node", "create_publisher"),
        ("calib_lifecycle_node", "rclpy.node", "Node", "create_publisher"),
        ("calib_node", "calib_ros.ros.diagnostics", "Diagnostics", "status"),
    ],
)
def test_a_signal_in_the_middle_of_making_or_publishing(entry_point, module, owner, name):
    """What is begun goes on as usual: nothing is published without a context, or made in half of one."""
    program = f"""
import os, sys
from calib_ros.ros.process import {entry_point}
from {module} import {owner}
original = {owner}.{name}
def signalled(*args, **named):
    os.kill(os.getpid(), {int(signal.SIGINT)})
    return original(*args, **named)
{owner}.{name} = signalled
sys.exit({entry_point}())
"""
    done = ran("-c", program)
    assert done.returncode == 0, done.stderr
    assert not [line for line in done.stderr.splitlines() if "[INFO]" not in line], done.stderr


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--params-file", "{bad}"], "bad.yaml"),
        (["--params-file", "/nowhere.yaml"], "nowhere.yaml"),
        (["-p", "image.mask:=/nowhere.png"], "cannot read image.mask /nowhere.png"),
    ],
)
def test_a_node_that_cannot_start_says_why_in_one_line(tmp_path, arguments, text):
    (tmp_path / "bad.yaml").write_text("/**:\n  ros__parameters:\n    search.seed: [1, 2\n")
    given = [argument.format(bad=tmp_path / "bad.yaml") for argument in arguments]
    done = ran("-m", "calib_ros.ros.process", "--ros-args", *given)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if "[WARN]" not in line]
    assert len(lines) == 1, done.stderr
    assert text in lines[0]


def test_a_player_says_where_it_follows_nobody(street_bag):
    player = play(street_bag, "--follow", "/nobody", "--wait", "0.2", "--rate", "50")
    _, err = player.communicate(timeout=LIMIT_S)
    assert player.returncode == 0, err
    assert "/nobody is not heard" in err


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
        assert is_near(source.reference, T, 0.35, 0.10)
        client.until(lambda: client.overlays > 0, "an overlay")
        end(node, signal.SIGTERM)


# The core alone, without the packages beside it: thesis, semantics, check, view, synthetic.
WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"calib_ros_" + n for n in ("thesis", "semantics", "check", "view", "synthetic")}:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
"""
NODE = WITHOUT + "from calib_ros.ros.process import calib_node\nsys.exit(calib_node())"


def test_the_node_calibrates_without_the_packages_beside_it(street_bag, drive):
    start = se3.perturb(drive.reference, [1.0, -1.5, 0.5], [0.05, 0.08, -0.05])
    with node_process(*initial(start), program=NODE, **QUICK, overlay_period_s=0.0) as node, Observer() as client:
        client.get_extrinsic()
        player = play(street_bag, "--rate", "4", "--follow", "/calib_ros", "--loop")
        client.until(lambda: client.get_extrinsic()[2].converged, "an estimate")
        found = client.get_extrinsic()[2]
        player.send_signal(signal.SIGINT)
        player.communicate(timeout=LIMIT_S)
        services = dict(client._node.get_service_names_and_types())
        end(node)
    assert is_near(drive.reference, found.T_camera_lidar, 0.3, 0.08)
    assert "/calib_ros/get_extrinsic" in services
    assert "/calib_ros/check" not in services


@pytest.mark.parametrize(
    ("arguments", "code"), [(["--help"], 0), (["info", "synthetic"], 2), (["calibrate", "x", "--objective", "thesis"], 2)]
)
def test_the_command_line_does_without_what_the_packages_bring(arguments, code):
    program = WITHOUT + f"from calib_ros.cli.main import main\nsys.exit(main({arguments!r}))"
    done = ran("-c", program)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert "evaluate" in done.stdout or code == 2
    assert " demo" not in done.stdout

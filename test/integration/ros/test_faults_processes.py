"""Killed processes and full disks: node, player and client run as processes of their own, as on a vehicle."""

from __future__ import annotations

import json
import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from ros_processes import Observer, end, initial, node_process, play
from sensor_msgs.msg import Image, PointCloud2
from vehicle import CLOSE_DEG, CLOSE_M, QUICK

from calib_ros import se3
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.slow]


def start(drive: SyntheticDrive) -> list[str]:
    return initial(se3.perturb(drive.reference, [1.0, -1.5, 0.5], [0.05, 0.08, -0.05]))


class Watch(Observer):
    """A client that knows the right extrinsic."""

    def __init__(self, drive: SyntheticDrive) -> None:
        super().__init__()
        self.reference = drive.reference

    def await_estimate(self) -> None:
        self.until(lambda: self.count("estimates accepted") > 1, "an estimate")

    def assert_recovers(self) -> None:
        """More pairs come, another estimate is accepted, and the service answers with the right extrinsic."""
        self.new_values()
        pairs, accepted = self.count("pairs"), self.count("estimates accepted")
        self.until(lambda: self.count("pairs") > pairs and self.count("estimates accepted") > accepted, "another estimate")
        self.assert_kept()

    def assert_kept(self) -> None:
        success, message, result, _ = self.get_extrinsic()
        assert success, message
        assert se3.rotation_error_deg(self.reference, result.T_camera_lidar) < CLOSE_DEG
        assert se3.translation_error_m(self.reference, result.T_camera_lidar) < CLOSE_M


@contextmanager
def playing(bag: Path) -> Iterator[subprocess.Popen[str]]:
    """A player that runs until it is killed, hard."""
    player = play(bag, "--rate", "4", "--loop")
    try:
        yield player
    finally:
        player.kill()
        player.communicate()


def test_a_publisher_is_killed_and_comes_back(street_bag, drive):
    """Twice, in the middle of its messages; between the two others publish the wrong types on the topics."""
    with node_process(*start(drive), **QUICK) as node, Watch(drive) as watch:
        with playing(street_bag):
            watch.await_estimate()
            watch.assert_recovers()
        watch.assert_kept()
        topics = {"/camera/image_raw": PointCloud2, "/velodyne_points": Image, "/camera/camera_info": Image}
        swapped = [watch._node.create_publisher(kind, topic, 10) for topic, kind in topics.items()]
        for _ in range(20):
            for publisher in swapped:
                publisher.publish(publisher.msg_type())
            watch.spin(0.02)
        watch.assert_kept()
        with playing(street_bag):
            watch.assert_recovers()
            for publisher in swapped:  # and beside the right ones
                publisher.publish(publisher.msg_type())
            watch.assert_recovers()
        watch.assert_kept()
        end(node)


def test_killed_node_restarts_with_the_last_good_extrinsic(street_bag, drive, tmp_path):
    """SIGKILL at any moment leaves a whole state file. The next node answers with it before the first image."""
    state = tmp_path / "state.json"
    settings = {**QUICK, "state_file": state}
    with playing(street_bag):
        for lives in range(2):
            with node_process(*start(drive), **settings) as node, Watch(drive) as watch:
                if lives:
                    watch.until(lambda w=watch: w.get_extrinsic()[0], "that keyframes confirm what was saved")
                    watch.assert_kept()
                watch.await_estimate()
                node.kill()
                node.wait()
            assert [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")] == [state.name]
            saved = json.loads(state.read_text())
            assert saved["status"] == "converged"
    with node_process(*start(drive), **settings), Watch(drive) as watch:  # nothing is published now
        _, message, result, _ = watch.get_extrinsic()
        assert message
        np.testing.assert_allclose(result.T_camera_lidar, saved["T_camera_lidar"], atol=1e-9)


def test_a_full_disk(street_bag, drive, tmp_path):
    """The node may write no byte more: it says so, keeps the state saved before whole, and saves again when there is room."""
    state = tmp_path / "state.json"
    with node_process(*start(drive), **QUICK, state_file=state) as node, Watch(drive) as watch:
        with playing(street_bag):
            watch.await_estimate()
        watch.until(lambda: float(watch.new_values()["worker load"]) == 0, "the end of all estimates")
        assert watch.trigger("save")[0]
        before = state.read_bytes()
        free = resource.prlimit(node.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(node.pid, resource.RLIMIT_FSIZE, (0, free[1]))
        success, message = watch.trigger("save")
        assert not success
        assert "cannot write" in message
        assert str(state) in message
        assert "\n" not in message
        watch.until(lambda: watch.values.get("last error") == message, "the error in the diagnostics")
        assert state.read_bytes() == before
        assert [path.name for path in tmp_path.iterdir()] == [state.name]
        watch.assert_kept()
        resource.prlimit(node.pid, resource.RLIMIT_FSIZE, free)
        assert watch.trigger("save")[0]
        with playing(street_bag):
            watch.assert_recovers()
        text = end(node)
    assert text.count("cannot write") == 1, text

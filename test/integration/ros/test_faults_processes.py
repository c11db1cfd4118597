"""Killed processes and full disks: node, player and client run as processes of their own, as on a vehicle."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from ros_processes import initial, node_process, play
from sensor_msgs.msg import Image, PointCloud2
from vehicle import CLOSE_DEG, CLOSE_M, QUICK

from calib_ros import se3
from calib_ros.ros.client import ExtrinsicClient
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = pytest.mark.ros
QUICKLY = ["semantics.segmentation:=none", *(f"{name.replace('__', '.')}:={value}" for name, value in QUICK.items())]


def start(drive: SyntheticDrive) -> list[str]:
    return initial(se3.perturb(drive.reference, [1.0, -1.5, 0.5], [0.05, 0.08, -0.05]))


class Watch:
    """What the node says of itself, and waiting for more of it."""

    def __init__(self, client: ExtrinsicClient, drive: SyntheticDrive) -> None:
        self.client, self.reference = client, drive.reference
        self.values: dict[str, str] = {}
        client._node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)

    def _take(self, msg: DiagnosticArray) -> None:
        self.values = {v.key: v.value for v in msg.status[0].values}

    def count(self, name: str) -> int:
        return int(self.values.get(name, 0))

    def until(self, condition: Callable[[], object], what: str) -> None:
        assert self.client.spin(120, lambda: bool(condition())), f"{what} did not happen: {self.values}"

    def assert_recovers(self) -> None:
        """More pairs come, another estimate is accepted, and the service answers with the right extrinsic."""
        self.values = {}
        self.until(lambda: self.values, "diagnostics")
        pairs, accepted = self.count("pairs"), self.count("estimates accepted")
        self.until(lambda: self.count("pairs") > pairs and self.count("estimates accepted") > accepted, "another estimate")
        self.assert_kept()

    def assert_kept(self) -> None:
        success, message, result, _ = self.client.get_extrinsic()
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


@pytest.mark.slow
def test_a_publisher_is_killed_and_comes_back(street_bag: Path, drive: SyntheticDrive) -> None:
    """Twice, in the middle of its messages; between the two others publish the wrong types on the topics."""
    with node_process(*start(drive), *QUICKLY) as node, ExtrinsicClient() as client:
        watch = Watch(client, drive)
        with playing(street_bag):
            watch.until(lambda: watch.count("estimates accepted") > 1, "an estimate")
            watch.assert_recovers()
        watch.assert_kept()
        topics = {"/camera/image_raw": PointCloud2, "/velodyne_points": Image, "/camera/camera_info": Image}
        swapped = [client._node.create_publisher(kind, topic, 10) for topic, kind in topics.items()]
        for _ in range(20):
            for publisher in swapped:
                publisher.publish(publisher.msg_type())
            client.spin(0.02)
        watch.assert_kept()
        with playing(street_bag):
            watch.assert_recovers()
            for publisher in swapped:  # and beside the right ones
                publisher.publish(publisher.msg_type())
            watch.assert_recovers()
        watch.assert_kept()
        node.send_signal(signal.SIGINT)
        assert node.wait(20) == 0
        assert "Traceback" not in node.stdout.read()


@pytest.mark.slow
def test_killed_node_restarts_with_the_last_good_extrinsic(street_bag: Path, drive: SyntheticDrive, tmp_path: Path) -> None:
    """SIGKILL at any moment leaves a whole state file. The next node answers with it before the first image."""
    state = tmp_path / "state.json"
    parameters = (*start(drive), *QUICKLY, f"state_file:={state}")
    with playing(street_bag), ExtrinsicClient() as client:
        for lives in range(2):
            with node_process(*parameters) as node:
                watch = Watch(client, drive)
                if lives:
                    watch.until(lambda w=watch: w.count("pairs") > 3, "pairs")
                    watch.assert_kept()
                watch.until(lambda w=watch: w.count("estimates accepted") > 1, "an estimate")
                node.kill()
                node.wait()
            assert [path.name for path in tmp_path.iterdir() if not path.name.startswith(".")] == [state.name]
            saved = json.loads(state.read_text())
            assert saved["status"] == "converged"
    with node_process(*parameters), ExtrinsicClient() as client:  # nothing is published now
        _, message, result, _ = client.get_extrinsic(30)
        assert message
        np.testing.assert_allclose(result.T_camera_lidar, saved["T_camera_lidar"], atol=1e-9)


@pytest.mark.slow
def test_a_full_disk(street_bag: Path, drive: SyntheticDrive, tmp_path: Path) -> None:
    """The node may write no byte more: it says so, keeps the state saved before whole, and saves again when there is room."""
    state = tmp_path / "state.json"
    with node_process(*start(drive), *QUICKLY, f"state_file:={state}") as node, ExtrinsicClient() as client:
        watch = Watch(client, drive)
        with playing(street_bag):
            watch.until(lambda: watch.count("estimates accepted") > 1, "an estimate")
        client.spin(1.5)
        assert client.trigger("save")[0]
        before = state.read_bytes()
        free = resource.prlimit(node.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(node.pid, resource.RLIMIT_FSIZE, (0, free[1]))
        success, message = client.trigger("save")
        assert not success
        assert "cannot write" in message
        assert str(state) in message
        assert "\n" not in message
        watch.until(lambda: watch.values.get("last error") == message, "the error in the diagnostics")
        assert state.read_bytes() == before
        assert [path.name for path in tmp_path.iterdir()] == [state.name]
        watch.assert_kept()
        resource.prlimit(node.pid, resource.RLIMIT_FSIZE, free)
        assert client.trigger("save")[0]
        with playing(street_bag):
            watch.assert_recovers()
        node.send_signal(signal.SIGINT)
        assert node.wait(20) == 0
        text = node.stdout.read()
    assert "Traceback" not in text
    assert text.count("cannot write") == 1, text

"""Faults of sensors, clocks, clients and disks, over real DDS in this process. After every fault the same node recovers."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from calib_ros_msgs.srv import GetExtrinsic
from ros_messages import Messages
from ros_peer import camera_info_message, cloud_message
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger
from vehicle import is_right, vehicle_fixture  # noqa: F401  # a fixture

from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.ros.client import result_from_message
from calib_ros.ros.conversions import image_message, time_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
HOUR, DAY = 3600.0, 86400.0


@pytest.fixture(autouse=True)
def recovery(vehicle):
    yield
    vehicle.assert_recovers()
    vehicle.assert_kept()


def test_camera_info_of_another_camera(vehicle):
    """Once, and then by turns, as when two drivers publish on one topic."""
    peer = vehicle.peer
    right, other = camera_info_message(vehicle.frame()), camera_info_message(vehicle.frame())
    other.width, other.height, other.k = 800, 600, np.array([700.0, 0, 400, 0, 700, 300, 0, 0, 1])
    for info in (other, *[right, other] * 5):
        peer.info_pub.publish(info)
        peer.until(lambda w=info.width: peer.pipeline.camera.width == w)
        vehicle.send(vehicle.frame())
        assert info is right or "CameraInfo says 800x600" in peer.last_error()
        vehicle.assert_kept()


def changed(message: Any, **fields: Any) -> Any:
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def of(frame: Frame, pixels: np.ndarray | None = None, **fields: Any) -> dict[str, Any]:
    return {"image": changed(image_message(frame.image if pixels is None else pixels, "camera", frame.stamp), **fields)}


def scan(frame: Frame, xyz: np.ndarray | None = None, **fields: Any) -> dict[str, Any]:
    return {"cloud": changed(cloud_message(frame.cloud if xyz is None else PointCloud(xyz), frame.stamp), **fields)}


def with_times(frame: Frame, ahead_s: float) -> dict[str, Any]:
    """Every point with a time of its own, of a clock that is ahead."""
    columns = dict(zip(("x", "y", "z", "intensity"), (*frame.cloud.xyz.T, frame.cloud.intensity), strict=True))
    points = np.empty(len(frame.cloud), [*((name, "f4") for name in columns), ("timestamp", "f8")])
    for name, values in columns.items():
        points[name] = values
    points["timestamp"] = np.linspace(0, 0.1, len(points)) + frame.stamp / NANOSECONDS + ahead_s
    return {"cloud": Messages("rclpy").cloud(points, stamp=frame.stamp, frame="velodyne")}


BAD: list[tuple[Callable[[Frame], dict[str, Any]], str]] = [
    (lambda f: of(f, f.image[:100]), "CameraInfo says"),
    (lambda f: of(f, encoding="", data=[]), "encoding ''"),
    (lambda f: scan(f, np.zeros((0, 3), np.float32)), "the cloud has 0 usable points"),
    (lambda f: scan(f, np.full((1000, 3), np.nan, np.float32)), "the LiDAR shows nothing (no returns"),  # by now it is known
    (lambda f: scan(f, fields=[]), "has no field x, y, z"),
    (lambda f: scan(f, width=2**31), "PointCloud2"),
    (lambda f: with_times(f, 37.0), "of another clock, +37 s from the header stamp"),
]


def test_bad_messages_leave_node_and_extrinsic_alone(vehicle, capfd):
    peer, health = vehicle.peer, vehicle.peer.calibration.health
    for make, text in BAD:
        frame, errors = vehicle.frame(), health.errors
        vehicle.send(frame, **make(frame))
        assert health.errors > errors, text
        assert text in peer.last_error()
        assert "\n" not in peer.last_error()
        now = peer.get_extrinsic()
        assert now.success == now.extrinsic.usable
        vehicle.assert_kept()
    errors = health.errors
    peer.info_pub.publish(changed(camera_info_message(vehicle.frame()), k=np.zeros(9)))
    peer.until(lambda: health.errors > errors, "a complaint about CameraInfo")
    assert "K is all zero" in peer.last_error()
    logged = capfd.readouterr()
    assert "Traceback" not in logged.err + logged.out
    assert "unexpected" not in logged.err + logged.out


@pytest.mark.parametrize("jump_s", [HOUR, -DAY])
def test_the_clock_of_one_sensor_jumps_and_comes_back(vehicle, jump_s):
    counts = vehicle.peer.pipeline.pairing.synchronizer.counts
    pairs = counts.pairs
    for _ in range(12):  # more than may wait for a partner
        frame = vehicle.frame(0.1)
        vehicle.send(frame, cloud=cloud_message(frame.cloud, frame.stamp + int(jump_s * NANOSECONDS)))
    assert counts.pairs == pairs
    vehicle.assert_kept()
    vehicle.send(vehicle.frame())  # what waits at the moment of the jump is dropped, and may be half of this pair


def test_a_simulated_clock_that_stands_still_and_jumps(vehicle):
    """A paused simulation, where all stamps stay where they are, and a bag that loops. Diagnostics and services go on."""
    peer, counts = vehicle.peer, vehicle.peer.pipeline.pairing.synchronizer.counts
    clock = peer.peer.create_publisher(Clock, "/clock", 10)

    def set_clock() -> None:
        clock.publish(Clock(clock=time_message(vehicle.stamp)))
        peer.until(lambda: peer.node.get_clock().now().nanoseconds == vehicle.stamp, "simulated time")

    try:
        peer.change(use_sim_time=True)
        peer.until(clock.get_subscription_count)
        set_clock()
        pairs = counts.pairs
        for _ in range(5):
            set_clock()
            vehicle.send(vehicle.frame(0))
            vehicle.assert_kept()
        assert counts.pairs == pairs + 5
        peer.new_values()
        assert peer.diagnostics[-1].header.stamp == time_message(vehicle.stamp)
        vehicle.assert_recovers()
        for jump_s in (DAY, -DAY):
            jumps = counts.jumps_back
            vehicle.send(vehicle.frame(jump_s))
            assert counts.jumps_back == jumps + (jump_s < 0)
            assert ("jumped back" in peer.last_error()) >= (jump_s < 0)
            set_clock()
            vehicle.assert_recovers()
            vehicle.assert_kept()
    finally:
        peer.change(use_sim_time=False)
        peer.peer.destroy_publisher(clock)


def test_eight_concurrent_clients(vehicle):
    """Each asks everything in an order of its own, while data flows. Every call is answered, and all tell of one state."""
    peer = vehicle.peer
    nodes = [rclpy.create_node(f"client_{k}", context=peer.context) for k in range(8)]
    for node in nodes:
        peer._executors[1][0].add_node(node)

    def ask(k: int) -> list[tuple[str, Any]]:
        names = np.random.default_rng(k).permutation(["get_extrinsic"] * 4 + ["save", "reset", "calibrate", "capture"])
        kinds = [GetExtrinsic if name == "get_extrinsic" else Trigger for name in names]
        clients = [nodes[k].create_client(kind, f"/calib_ros/{name}") for kind, name in zip(kinds, names, strict=True)]
        return [(name, peer.call(client, kind.Request())) for name, kind, client in zip(names, kinds, clients, strict=True)]

    with ThreadPoolExecutor(8) as pool:
        asked = [pool.submit(ask, k) for k in range(8)]
        while not all(future.done() for future in asked):
            peer.publish(vehicle.frame(1.0), settle=False)
            time.sleep(0.1)
    answers = [answer for future in asked for answer in future.result()]
    for node in nodes:
        peer._executors[1][0].remove_node(node)
        node.destroy_node()
    assert len(answers) == 8 * 8
    start = peer.recalibrator.tracker.initial.T_camera_lidar
    for name, answer in answers:
        if name == "get_extrinsic":
            T = result_from_message(answer.extrinsic).T_camera_lidar
            assert np.allclose(T, start, atol=1e-9) or is_right(vehicle.reference, answer.extrinsic, 1.5)
        else:
            assert answer.message
            assert answer.success or name != "reset"
    peer.settle()
    T = result_from_message(peer.get_extrinsic().extrinsic).T_camera_lidar
    np.testing.assert_allclose(T, peer.recalibrator.current.result.T_camera_lidar, atol=1e-9)
    vehicle.assert_recovers()  # after the last reset
    vehicle.forget_published()
    now = peer.get_extrinsic().extrinsic
    peer.until(lambda: peer.extrinsics[-1].transform.transform == now.transform.transform, "the current extrinsic as a message")
    assert peer.trigger("save").success
    saved = json.loads(Path(peer.calibration.parameters["state_file"]).read_text())
    np.testing.assert_allclose(saved["T_camera_lidar"], result_from_message(now).T_camera_lidar, atol=1e-9)


def test_a_state_folder_that_cannot_be_written(vehicle):
    """A file stands where the folder was: not even root can write there. The node says so, and goes on."""
    peer = vehicle.peer
    state = Path(peer.calibration.parameters["state_file"])
    before, aside = state.read_bytes(), state.parent.with_name("aside")
    state.parent.rename(aside)
    state.parent.write_text("")
    try:
        errors = peer.calibration.health.errors
        vehicle.assert_recovers()  # it tries to save what it found
        assert peer.calibration.health.errors > errors
        assert "cannot write" in peer.last_error()
        refusal = peer.refusal("save")
        assert refusal == peer.last_error()
        assert str(state) in refusal
    finally:
        state.parent.unlink()
        aside.rename(state.parent)
    assert state.read_bytes() == before
    assert peer.trigger("save").success
    assert os.listdir(state.parent) == [state.name]

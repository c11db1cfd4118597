"""Faults of sensors and clocks, over real DDS in this process. After every fault the same node recovers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from ros_peer import camera_info_message, cloud_message
from rosgraph_msgs.msg import Clock
from vehicle import Vehicle, vehicle_fixture  # noqa: F401  # fixtures

from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.ros.conversions import image_message, time_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
HOUR, DAY = 3600.0, 86400.0


def test_camera_info_of_another_camera(vehicle: Vehicle) -> None:
    """Once, and then by turns, as when two drivers publish on one topic."""
    peer = vehicle.peer
    right = camera_info_message(vehicle.frame())
    other = camera_info_message(vehicle.frame())
    other.width, other.height, other.k = 800, 600, np.array([700.0, 0, 400, 0, 700, 300, 0, 0, 1])
    peer.info_pub.publish(other)
    peer.until(lambda: peer.pipeline.camera.width == 800)
    for _ in range(3):
        vehicle.send(vehicle.frame())
        assert "CameraInfo says 800x600" in peer.last_error()
        vehicle.assert_kept()
    for info in [right, other] * 5:
        peer.info_pub.publish(info)
        peer.until(lambda w=info.width: peer.pipeline.camera.width == w)
        vehicle.send(vehicle.frame())
        vehicle.assert_kept()
    vehicle.assert_recovers()
    vehicle.assert_kept()


def changed(message: Any, **fields: Any) -> Any:
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def of(frame: Frame, pixels: np.ndarray | None = None, **fields: Any) -> dict[str, Any]:
    return {"image": changed(image_message(frame.image if pixels is None else pixels, "camera", frame.stamp), **fields)}


def scan(frame: Frame, xyz: np.ndarray | None = None, **fields: Any) -> dict[str, Any]:
    return {"cloud": changed(cloud_message(frame.cloud if xyz is None else PointCloud(xyz), frame.stamp), **fields)}


BAD: list[tuple[Callable[[Frame], dict[str, Any]], str]] = [
    (lambda f: of(f, f.image[:100]), "CameraInfo says"),
    (lambda f: of(f, f.image.transpose(1, 0, 2)), "CameraInfo says"),
    (lambda f: of(f, np.repeat(f.image, 2, axis=1)), "CameraInfo says"),
    (lambda f: of(f, encoding="64FC3"), "encoding '64FC3'"),
    (lambda f: of(f, encoding="rgba8"), "step"),
    (lambda f: of(f, encoding="", data=[]), "encoding ''"),
    (lambda f: of(f, width=0), "no pixels"),
    (lambda f: scan(f, np.zeros((0, 3), np.float32)), "the cloud has 0 usable points"),
    (lambda f: scan(f, np.full((1000, 3), np.nan, np.float32)), "the cloud has 0 usable points"),
    (lambda f: scan(f, data=bytes(1000)), "PointCloud2"),
    (lambda f: scan(f, fields=[]), "PointCloud2"),
    (lambda f: scan(f, point_step=0), "PointCloud2"),
    (lambda f: scan(f, width=2**31), "PointCloud2"),
]


def test_bad_messages_leave_node_and_extrinsic_alone(vehicle: Vehicle, capfd: pytest.CaptureFixture[str]) -> None:
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
    vehicle.assert_recovers()  # the last good camera has stayed
    vehicle.assert_kept()
    logged = capfd.readouterr()
    assert "Traceback" not in logged.err + logged.out
    assert "unexpected" not in logged.err + logged.out


@pytest.mark.parametrize("jump_s", [HOUR, -DAY, -2 * HOUR])
def test_clock_jumps(vehicle: Vehicle, jump_s: float) -> None:
    """Both sensors' stamps jump forward by an hour, or back by a day."""
    counts = vehicle.peer.pipeline.synchronizer.counts
    jumps = counts.jumps_back
    vehicle.send(vehicle.frame(jump_s))
    assert counts.jumps_back == jumps + (jump_s < 0)
    assert ("jumped back" in vehicle.peer.last_error()) >= (jump_s < 0)
    vehicle.assert_kept()
    vehicle.assert_recovers()
    vehicle.assert_kept()


@pytest.mark.parametrize("jump_s", [HOUR, -DAY])
def test_the_clock_of_one_sensor_jumps_and_comes_back(vehicle: Vehicle, jump_s: float) -> None:
    counts = vehicle.peer.pipeline.synchronizer.counts
    pairs = counts.pairs
    for _ in range(12):  # more than may wait for a partner
        frame = vehicle.frame(0.1)
        vehicle.send(frame, cloud=cloud_message(frame.cloud, frame.stamp + int(jump_s * NANOSECONDS)))
    assert counts.pairs == pairs
    vehicle.assert_kept()
    vehicle.send(vehicle.frame())  # what waits at the moment of the jump is dropped, and may be half of this pair
    vehicle.assert_recovers()
    vehicle.assert_kept()


def test_a_simulated_clock_that_stands_still_and_jumps(vehicle: Vehicle) -> None:
    """A paused simulation, where all stamps stay where they are, and a bag that loops. Diagnostics and services go on."""
    peer, counts = vehicle.peer, vehicle.peer.pipeline.synchronizer.counts
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
            vehicle.send(vehicle.frame(jump_s))
            set_clock()
            vehicle.assert_recovers()
            vehicle.assert_kept()
    finally:
        peer.change(use_sim_time=False)
        peer.peer.destroy_publisher(clock)
    vehicle.assert_recovers()
    vehicle.assert_kept()

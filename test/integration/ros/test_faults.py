"""Faults of sensors and clocks, over real DDS in this process. After every fault the same node recovers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter
from ros_peer import camera_info_message, cloud_message
from rosgraph_msgs.msg import Clock
from vehicle import Vehicle, vehicle_fixture  # noqa: F401  # fixtures

from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.ros.conversions import image_message, time_message

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
HOUR, DAY = 3600.0, 86400.0


def test_images_of_another_size(vehicle: Vehicle) -> None:
    peer = vehicle.peer
    for pixels in (lambda i: i[:100], lambda i: i.transpose(1, 0, 2), lambda i: np.repeat(i, 2, axis=1)):
        frame, errors = vehicle.frame(), peer.calibration.health.errors
        vehicle.send(frame, image_message(pixels(frame.image), "camera", frame.stamp))
        assert peer.calibration.health.errors == errors + 1
        assert "CameraInfo says" in peer.last_error()
        vehicle.assert_kept()
    vehicle.assert_recovers()
    vehicle.assert_kept()


def test_camera_info_of_another_camera(vehicle: Vehicle) -> None:
    """Once, and then by turns, as when two drivers publish on one topic."""
    peer = vehicle.peer
    right = camera_info_message(vehicle.frame())
    other = camera_info_message(vehicle.frame())
    other.width, other.height, other.k = 800, 600, np.array([700.0, 0, 400, 0, 700, 300, 0, 0, 1])
    peer.info_pub.publish(other)
    peer.until(lambda: peer.calibration.pipeline.camera.width == 800)
    for _ in range(3):
        vehicle.send(vehicle.frame())
        assert "CameraInfo says 800x600" in peer.last_error()
        vehicle.assert_kept()
    for info in [right, other] * 5:
        peer.info_pub.publish(info)
        peer.until(lambda w=info.width: peer.calibration.pipeline.camera.width == w)
        vehicle.send(vehicle.frame())
        vehicle.assert_kept()
    vehicle.assert_recovers()
    vehicle.assert_kept()


def test_inconsistent_messages_are_refused(vehicle: Vehicle) -> None:
    peer = vehicle.peer

    def image(frame: Frame, **changed: Any) -> Any:
        msg = image_message(frame.image, "camera", frame.stamp)
        for name, value in changed.items():
            setattr(msg, name, value)
        return msg

    def cloud(frame: Frame, **changed: Any) -> Any:
        msg = cloud_message(frame.cloud, frame.stamp)
        for name, value in changed.items():
            setattr(msg, name, value)
        return msg

    for make, text in (
        (lambda f: (image(f, encoding="64FC3"), None), "encoding '64FC3'"),
        (lambda f: (image(f, encoding="rgba8"), None), "step"),
        (lambda f: (image(f, encoding="", data=[]), None), "encoding ''"),
        (lambda f: (image(f, width=0), None), "no pixels"),
        (lambda f: (None, cloud(f, fields=[])), "PointCloud2"),
        (lambda f: (None, cloud(f, point_step=0)), "PointCloud2"),
        (lambda f: (None, cloud(f, width=2**31)), "PointCloud2"),
    ):
        frame, errors = vehicle.frame(), peer.calibration.health.errors
        vehicle.send(frame, *make(frame))
        assert peer.calibration.health.errors == errors + 1, text
        assert text in peer.last_error()
        assert "unexpected" not in peer.last_error()
        vehicle.assert_kept()
    vehicle.assert_recovers()
    vehicle.assert_kept()


@pytest.mark.parametrize("jump_s", [HOUR, -DAY, -2 * HOUR])
def test_clock_jumps(vehicle: Vehicle, jump_s: float) -> None:
    """Both sensors' stamps jump forward by an hour, or back by a day."""
    jumps = vehicle.peer.calibration.pipeline.synchronizer.counts.jumps_back
    vehicle.send(vehicle.frame(jump_s))
    assert vehicle.peer.calibration.pipeline.synchronizer.counts.jumps_back == jumps + (jump_s < 0) * 1
    vehicle.assert_kept()
    vehicle.assert_recovers()
    vehicle.assert_kept()


@pytest.mark.parametrize("jump_s", [HOUR, -DAY])
def test_the_clock_of_one_sensor_jumps_and_comes_back(vehicle: Vehicle, jump_s: float) -> None:
    counts = vehicle.peer.calibration.pipeline.synchronizer.counts
    pairs = counts.pairs
    for _ in range(12):  # more than may wait for a partner
        frame = vehicle.frame(0.1)
        vehicle.send(frame, cloud=cloud_message(frame.cloud, frame.stamp + int(jump_s * NANOSECONDS)))
    assert counts.pairs == pairs
    vehicle.assert_kept()
    vehicle.send(vehicle.frame())  # what waits at the moment of the jump is dropped, and may be half of this pair
    vehicle.assert_recovers()
    vehicle.assert_kept()


def test_constant_stamps(vehicle: Vehicle) -> None:
    """A paused simulation: the node's clock and all stamps stay where they are. Diagnostics and services go on."""
    peer = vehicle.peer
    clock = peer.peer.create_publisher(Clock, "/clock", 10)
    try:
        assert peer.node.set_parameters([Parameter("use_sim_time", value=True)])[0].successful
        peer.until(clock.get_subscription_count)
        now = time_message(vehicle.stamp)
        clock.publish(Clock(clock=now))
        peer.until(lambda: peer.node.get_clock().now().nanoseconds == vehicle.stamp, what="simulated time")
        pairs = peer.calibration.pipeline.synchronizer.counts.pairs
        for _ in range(5):
            clock.publish(Clock(clock=now))
            vehicle.send(vehicle.frame(0))
            vehicle.assert_kept()
        assert peer.calibration.pipeline.synchronizer.counts.pairs == pairs + 5
        told = len(peer.diagnostics)
        peer.until(lambda: len(peer.diagnostics) >= told + 2, what="diagnostics")
        assert peer.diagnostics[-1].header.stamp == now
        vehicle.assert_recovers()
        vehicle.assert_kept()
    finally:
        assert peer.node.set_parameters([Parameter("use_sim_time", value=False)])[0].successful
        peer.peer.destroy_publisher(clock)
    vehicle.assert_recovers()
    vehicle.assert_kept()

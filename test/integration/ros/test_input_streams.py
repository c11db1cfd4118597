"""Streams as vehicles deliver them, over real DDS: stamps of all kinds, messages that get lost, what tells the motion."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import count, cycle, islice

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_peer import Peer, cloud_message, start_parameters
from scenes import RenderedDrive
from sensor_msgs.msg import Image, Imu
from vehicle import QUICK, is_right
from waiting import until

from calib_ros import se3
from calib_ros.frame import NANOSECONDS
from calib_ros.messages import stamp_ns
from calib_ros.online import events
from calib_ros.ros import inputs
from calib_ros.ros.conversions import image_message, time_message
from calib_ros.ros.diagnostics import SILENCE_S

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
PERIOD = NANOSECONDS // 10
MS = NANOSECONDS // 1000
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_scans_stamped_at_their_end_pair_with_the_images_in_their_middle(street, drive):
    stamped_s = 0.05
    rng, first, n_frames = np.random.default_rng(0), street[0].stamp, 30
    keep = {"capture_frames": n_frames, "online__keyframe_spacing_s": 0.0, "online__mode": "manual"}
    with Peer(**start_parameters(drive.reference), **{**QUICK, **keep}, monitor__enabled=False) as peer:
        counts = peer.pipeline.pairing.synchronizer.counts
        peer.publish_camera(street[0])
        for k, frame in enumerate(islice(cycle(street), n_frames)):
            middle = first + k * PERIOD
            cloud = replace(frame.cloud, time=(frame.cloud.time - stamped_s).astype(np.float32))
            image_stamp = middle + int(rng.integers(-5 * MS, 5 * MS))
            stamp = middle + round(stamped_s * NANOSECONDS)
            peer.send(image_message(frame.image, "camera", image_stamp), cloud_message(cloud, stamp))
        assert counts.pairs >= n_frames - 2
        kept = peer.calibration.capture._frames
        assert len(kept) >= 3
        for pair in kept:
            late = stamp_ns(pair.cloud.header.stamp) - stamp_ns(pair.image.header.stamp)
            assert abs(late - round(stamped_s * NANOSECONDS)) <= 5 * MS
        assert peer.new_values()["from a cloud's stamp to its sweep of the view, ms"] == f"{-1000 * stamped_s:.0f}"


def test_a_stream_with_lost_messages_is_named_until_it_ends(street, monkeypatch, capfd):
    monkeypatch.setattr(events, "REPEAT_S", 0.0)  # no line is left out
    lost = np.random.default_rng(0).random(600) < 0.5
    with Peer() as peer:
        driver = peer.peer.create_publisher(Image, "image", BEST_EFFORT)
        peer.until(driver.get_subscription_count)
        picture, first = street[0].image[:8].copy(), street[0].stamp
        counts = peer.pipeline.pairing.synchronizer.counts
        for sent, k in enumerate(np.flatnonzero(~lost).tolist()):
            driver.publish(image_message(picture, "camera", first + k * PERIOD))
            peer.until(lambda n=sent: counts.images > n)
        peer.until(lambda: peer.warns("of the messages on /image get lost", "fastdds_profile.xml", "compressed"))
        shares = [f"{share}% of the messages on /image" for share in range(35, 60)]
        peer.until(lambda: any(peer.warns(share) for share in shares), "the share of all that were sent")
        assert not peer.warns("on /points")
        assert [peer.peer.count_subscribers(f"/{name}") for name in ("odom", "imu", "twist")] == [0, 0, 0]  # no motion_source
        assert "on /image get lost" in peer.last_error()
        monkeypatch.setattr(inputs, "SILENCE_S", SILENCE_S)
        peer.until(lambda: not peer.calibration.health.losses, "that the driver has ended")
    told = [line for line in capfd.readouterr().err.splitlines() if "/image" in line]
    assert 2 <= len(told) <= 5, told
    assert "/image is published, but nothing comes" in told[-1]


def test_clouds_of_another_clock_are_paired_as_received_and_it_is_told(street, drive):
    with Peer(**start_parameters(drive.reference), **QUICK) as peer:
        peer.publish_camera(street[0])
        frames, ahead = cycle(street), 37 * NANOSECONDS
        stamps = count(1_750_000_000 * NANOSECONDS, PERIOD)

        def go_on() -> None:
            stamp, frame = next(stamps), next(frames)
            peer.send(image_message(frame.image, "camera", stamp), cloud_message(frame.cloud, stamp + ahead))

        until(lambda: peer.pipeline.last_keyframe is not None, "a keyframe", go_on)
        kept = peer.pipeline.last_keyframe
        assert abs(kept.moment_of_cloud - kept.stamp) < 0.2 * NANOSECONDS
        until(lambda: peer.warns("TAI and UTC", "paired as received", "synchronise the clocks"), "what was done", go_on)


# A driver whose images of 25 MB do not fit the shared memory that Fast DDS has by default.
LARGE_IMAGES = """
import array, itertools, time
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

rclpy.init()
node = rclpy.create_node("driver")
publisher = node.create_publisher(Image, "image", QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
image = Image(height=2500, width=3333, step=9999, encoding="bgr8")
image.data = array.array("B", bytes(2500 * 9999))
for k in itertools.count():
    image.header.stamp.sec, image.header.stamp.nanosec = 1000 + k // 10, k % 10 * 10**8
    publisher.publish(image)
    time.sleep(0.1)
"""


def test_images_that_do_not_fit_the_drivers_memory_are_named(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")  # the driver is a process of its own, as on a vehicle
    with Peer() as peer, subprocess.Popen([sys.executable, "-c", LARGE_IMAGES]) as driver:
        try:
            peer.until(lambda: peer.warns("of the messages on /image get lost", "fastdds_profile_large.xml"))
        finally:
            driver.kill()


def test_a_camera_that_is_stamped_late_is_found_with_the_mount():
    size = {"frames": 11, "width": 640, "height": 240, "rings": 32}
    drive = RenderedDrive(seed=3, **size, speed=8, stride=3, ride="weaving", image_late_ms=80.0)
    T = se3.perturb(drive.reference, [0.3, -0.2, 0.2], [0.02, 0, 0])
    keyframes = {"min_keyframes": 5, "buffer_size": 12, "similarity_threshold": 1.0, "mode": "manual"}
    options = {**QUICK, **{f"online__{name}": value for name, value in keyframes.items()}}
    with Peer(**start_parameters(T), **options, initial_from_tf=False) as peer:
        for k in range(len(drive)):
            # The motion is that of the scans. A pair is final when the next messages have come.
            frame = drive[k]
            peer.publish_camera(frame)
            cloud = cloud_message(frame.cloud, frame.cloud_stamp or frame.stamp)
            peer.send(image_message(frame.image, "camera", frame.stamp), cloud)
        answer = peer.trigger("calibrate")
        assert answer.success, answer.message
        message = peer.get_extrinsic().extrinsic
        assert message.time_offset == pytest.approx(0.08, abs=0.005)
        assert 0 < message.time_offset_sigma < 0.01
        assert is_right(drive.reference, message, 0.4)
        assert float(peer.new_values()["time offset, ms"].split()[0]) == pytest.approx(80, abs=5)
        assert peer.pipeline.pairing.sweep.config.time_offset_s == pytest.approx(0.08, abs=0.005)


@pytest.mark.parametrize(("source", "kind"), [("twist", TwistStamped), ("imu", Imu)])
def test_no_keyframe_in_a_sharp_turn(street, drive, source, kind):
    with Peer(**start_parameters(drive.reference), online__mode="manual", motion_source=source) as peer:
        publisher, gate = peer.peer.create_publisher(kind, source, 10), peer.pipeline.speed_gate
        peer.until(publisher.get_subscription_count)
        for frame, turn_deg, keyframes in zip(street, (3.0, 45.0, -45.0, 3.0), (1, 1, 1, 2), strict=False):
            stamp, message = frame.stamp + NANOSECONDS // 20, kind()
            message.header.stamp = time_message(stamp)
            if source == "twist":
                message.twist.linear.x, message.twist.angular.z = 5.0, np.deg2rad(turn_deg)
            else:
                message.angular_velocity.y = np.deg2rad(turn_deg)
            publisher.publish(message)
            peer.until(lambda stamp=stamp: gate.newest is not None and gate.newest[0] == stamp)
            peer.publish(frame)
            assert peer.recalibrator.keyframes.seen == keyframes
        peer.until(lambda: peer.values.get("frames too fast for a keyframe") == "2")
        assert peer.values["the newest of them"] == "45.0 deg/s are above online.max_turn_deg_s = 30"
        assert gate.motion_at(street[3])[0] == (5.0 if source == "twist" else pytest.approx(3.0, abs=0.1))

"""Streams as vehicles deliver them, over real DDS: scans stamped at their start, messages that get lost."""

from __future__ import annotations

from dataclasses import replace
from itertools import count, cycle, islice

import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_peer import Peer, camera_info_message, cloud_message, start_parameters
from sensor_msgs.msg import Image
from vehicle import QUICK

from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.messages import stamp_ns
from calib_ros.ros.conversions import image_message
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
PERIOD = NANOSECONDS // 10
MS = NANOSECONDS // 1000
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.mark.parametrize("stamped_s", [-0.05, 0.05], ids=["start", "end"])
def test_scans_stamped_at_their_start_or_end_pair_with_the_images_in_their_middle(
    street: list[Frame], drive: SyntheticDrive, stamped_s: float
) -> None:
    rng, first, n_frames = np.random.default_rng(0), street[0].stamp, 60
    keep = {"capture_frames": n_frames, "online__keyframe_spacing_s": 0.0, "online__mode": "manual"}
    with Peer(**start_parameters(drive.reference), **{**QUICK, **keep}, monitor__enabled=False) as peer:
        counts = peer.calibration.pipeline.synchronizer.counts
        peer.info_pub.publish(camera_info_message(street[0]))
        peer.until(lambda: peer.calibration.pipeline.camera is not None)
        for k, frame in enumerate(islice(cycle(street), n_frames)):
            middle = first + k * PERIOD
            cloud = replace(frame.cloud, time=(frame.cloud.time - stamped_s).astype(np.float32))
            image_stamp = middle + int(rng.integers(-5 * MS, 5 * MS))
            peer.image_pub.publish(image_message(frame.image, "camera", image_stamp))
            peer.cloud_pub.publish(cloud_message(cloud, middle + round(stamped_s * NANOSECONDS)))
            peer.until(lambda n=k: counts.images > n and counts.clouds > n)
            peer.settle()
        assert counts.pairs >= 0.95 * n_frames
        made = [
            (stamp_ns(kept.image.header.stamp), stamp_ns(kept.cloud.header.stamp)) for kept in peer.calibration.capture._frames
        ]
        assert len(made) >= 6
        for image, cloud in made:
            assert abs(image - (cloud - round(stamped_s * NANOSECONDS))) <= 5 * MS
        values = {v.key: v.value for v in peer.until(lambda: peer.diagnostics)[-1].status[0].values}
        assert values["from a cloud's stamp to its sweep of the view, ms"] == f"{-1000 * stamped_s:.0f}"


def test_a_stream_with_lost_messages_is_named(street: list[Frame]) -> None:
    lost = np.random.default_rng(0).random(200) < 0.4
    with Peer() as peer:
        driver = peer.peer.create_publisher(Image, "image", BEST_EFFORT)
        peer.until(driver.get_subscription_count)
        picture, first = street[0].image[:8].copy(), street[0].stamp
        counts = peer.calibration.pipeline.synchronizer.counts
        for sent, k in enumerate(np.flatnonzero(~lost).tolist()):
            driver.publish(image_message(picture, "camera", first + k * PERIOD))
            peer.until(lambda n=sent: counts.images > n)
        peer.until(lambda: peer.warns("of the messages on /image get lost", "fastdds_profile.xml", "compressed"))
        shares = [f"{share}% of the messages on /image" for share in range(30, 50)]
        peer.until(lambda: any(peer.warns(share) for share in shares), what="the share of all that were sent")
        assert not peer.warns("on /points")
        assert "on /image get lost" in peer.last_error()


def test_images_of_another_clock_are_named(street: list[Frame], drive: SyntheticDrive) -> None:
    with Peer(**start_parameters(drive.reference), **QUICK) as peer:
        counts, frame = peer.calibration.pipeline.synchronizer.counts, street[0]
        peer.info_pub.publish(camera_info_message(frame))
        peer.until(lambda: peer.calibration.pipeline.camera is not None)
        said = len(peer.diagnostics)
        for k in count():
            if peer.warns("find no partner", "is stamped 37 s before the newest cloud"):
                break
            peer.image_pub.publish(image_message(frame.image, "camera", frame.stamp + k * PERIOD))
            peer.cloud_pub.publish(cloud_message(frame.cloud, frame.stamp + k * PERIOD + 37 * NANOSECONDS))
            peer.until(lambda n=k: counts.images > n and counts.clouds > n)
            assert len(peer.diagnostics) < said + 30, peer.diagnostics[-1].status[0].message
        assert counts.pairs == 0

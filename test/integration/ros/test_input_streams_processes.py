"""Messages that get lost between processes: the driver's is one of its own, as on a vehicle."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from ros_peer import Peer

pytestmark = pytest.mark.ros

# A driver whose images of 25 MB do not fit the shared memory that Fast DDS has by default.
LARGE_IMAGES = """
import array, time
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

rclpy.init()
node = rclpy.create_node("driver")
publisher = node.create_publisher(Image, "image", QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
image = Image(height=2500, width=3333, step=9999, encoding="bgr8")
image.data = array.array("B", bytes(2500 * 9999))
for k in range(600):
    image.header.stamp.sec, image.header.stamp.nanosec = 1000 + k // 10, k % 10 * 10**8
    publisher.publish(image)
    time.sleep(0.1)
"""


@contextmanager
def process(code: str) -> Iterator[None]:
    started = subprocess.Popen([sys.executable, "-c", code])
    try:
        yield
    finally:
        started.kill()
        started.wait()


def test_images_that_do_not_fit_the_drivers_memory_are_named() -> None:
    with Peer() as peer, process(LARGE_IMAGES):
        peer.until(lambda: peer.warns("of the messages on /image get lost", "fastdds_profile_large.xml"))

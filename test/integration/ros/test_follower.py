"""How `calib-ros play --follow` waits for a node."""

from __future__ import annotations

from itertools import count

import pytest
import rclpy
from builtin_interfaces.msg import Time
from rclpy.context import Context
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header
from waiting import until

from calib_ros.ros.bags import Follower

pytestmark = pytest.mark.ros


def test_a_follower_keeps_one_scan_on_its_way(ros_in_this_process):
    """Topics that the node does not subscribe to, and messages that got lost, hold nothing up."""
    context = Context()
    rclpy.init(context=context)
    nodes = [rclpy.create_node(name, context=context) for name in ("calib_ros", "player")]

    def turns(most: int) -> int:
        """How often it looks before it goes on; it is told to give up after so many."""
        looks = count(1)
        follower.wait(lambda: next(looks) > most)
        return next(looks) - 1

    def send(stamp: int) -> None:
        follower.add("/other_image", stamp, "rear", False)
        follower.add("/image", stamp, "camera", False)
        follower.add("/points", stamp, "lidar", True)

    def done(stamp: int, frame: str) -> None:
        processed.publish(Header(stamp=Time(nanosec=stamp), frame_id=frame))

    try:
        kept = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        follower, processed = Follower(nodes[1], "/calib_ros"), nodes[0].create_publisher(Header, "/calib_ros/processed", kept)
        for kind, topic in ((Image, "/image"), (PointCloud2, "/points")):
            nodes[0].create_subscription(kind, topic, lambda _: None, 10)
        until(
            lambda: processed.get_subscription_count() == 1 and all(map(follower.subscribes_to, ("/image", "/points"))),
            "the follower",
        )
        assert not follower.subscribes_to("/other_image")
        assert turns(5) == 0
        send(1)
        assert turns(5) == 6  # nothing comes: it gives up
        send(2)
        assert turns(5) == 1  # and does not wait again until something does
        send(3)
        done(2, "lidar")
        done(3, "camera")  # those before got lost
        until(lambda: turns(5) == 0, "that header")
        send(4)
        done(4, "lidar")
        assert 0 < turns(1000) <= 1000  # the image, sent before this scan, got lost
        send(5)
        done(5, "camera")
        assert 0 < turns(1000) <= 1000  # its scan may be on the way
        assert turns(5) == 0
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown(context=context)

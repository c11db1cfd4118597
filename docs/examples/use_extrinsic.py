"""A node that uses the extrinsic of calib_ros safely: only while the newest message says so, and messages keep coming.

python3 use_extrinsic.py --ros-args -r extrinsic:=/calib_ros/extrinsic
"""

from contextlib import suppress

import rclpy
from calib_ros_msgs.msg import Extrinsic
from geometry_msgs.msg import Transform
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time

SILENCE = Duration(seconds=3.0)  # at least 2.5 times publish_period_s of calib_node


class ExtrinsicUser(Node):
    """Keeps the newest message; `usable()` gives its transform, or None where there is none to rely on."""

    def __init__(self, **kwargs):
        super().__init__("extrinsic_user", **kwargs)
        self.newest = None
        profile = QoSProfile(
            depth=1,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,  # the newest message at once, however late this node starts
            deadline=SILENCE,
            liveliness=LivelinessPolicy.AUTOMATIC,
            liveliness_lease_duration=SILENCE,
        )
        events = SubscriptionEventCallbacks(deadline=self.on_silence, liveliness=self.on_liveliness)
        self.create_subscription(Extrinsic, "extrinsic", self.on_extrinsic, profile, event_callbacks=events)

    def usable(self) -> Transform | None:
        """The transform that maps LiDAR points into the camera, for use right now."""
        msg = self.newest
        if msg is None or not msg.usable or self.get_clock().now() > Time.from_msg(msg.valid_until):
            return None
        return msg.transform.transform

    def on_extrinsic(self, msg):
        if self.newest is None or msg.usable != self.newest.usable:
            self.get_logger().info(f"extrinsic {msg.status}, {'' if msg.usable else 'not '}usable. {msg.reason}")
        self.newest = msg

    def on_silence(self, event):
        self.newest = None
        self.get_logger().warning("no extrinsic for 3 s: going on without")

    def on_liveliness(self, event):
        if event.alive_count == 0:
            self.newest = None
            self.get_logger().warning("calib_node has ended: going on without extrinsic")


def main():
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(ExtrinsicUser())


if __name__ == "__main__":
    main()

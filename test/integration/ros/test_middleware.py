"""Other distributions of ROS 2 and other middlewares than those that the tests run on."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from ros_peer import Peer, start_parameters

from calib_ros.ros import distributions, subscriptions
from calib_ros.ros.subscriptions import loss_advice

pytestmark = pytest.mark.ros

# The node where modules of rclpy that came after Humble, or are gone in Rolling, do not exist.
OTHER_RCLPY = """
import sys
import rclpy.executors, rclpy.lifecycle
sys.modules["rclpy.qos_event"] = sys.modules["rclpy.event_handler"]  # of Humble, with the same classes
for name in ("event_handler", "endpoint_info", "topic_endpoint_info", "parameter_client", "parameter_event_handler", "type_hash"):
    sys.modules[f"rclpy.{name}"] = None
import calib_ros.ros.bags, calib_ros.ros.client, calib_ros.ros.node, calib_ros_view.node.watch
from calib_ros.ros.distributions import SubscriptionEventCallbacks
from calib_ros.ros.node import CalibNode
rclpy.init()
node = CalibNode()
print(SubscriptionEventCallbacks.__module__, len(node.calibration.sensors.adaptive))
node.destroy_node()
rclpy.try_shutdown()
"""


def test_the_node_needs_no_module_that_only_some_distributions_have():
    ran = subprocess.run([sys.executable, "-c", OTHER_RCLPY], capture_output=True, text=True, check=False)
    assert ran.stdout.split() == ["rclpy.event_handler", "3"], ran.stderr


@pytest.mark.parametrize(
    ("rclpy", "discovery", "profile"),
    [
        ("3.3.15", "ROS_LOCALHOST_ONLY", "FASTRTPS_DEFAULT_PROFILES_FILE"),  # Humble
        ("4.1.4", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"),  # Iron
        ("7.1.6", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"),  # Jazzy
        ("9.1.2", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTDDS_DEFAULT_PROFILES_FILE"),  # Kilted
        ("12.0.0", "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTDDS_DEFAULT_PROFILES_FILE"),  # Rolling
    ],
)
def test_environment_variables_are_those_of_the_distribution(monkeypatch, rclpy, discovery, profile):
    monkeypatch.setattr(distributions, "version", {"rclpy": rclpy}.get)
    assert list(distributions.on_this_machine_only()) == [discovery]
    assert distributions.profile_variables()[0] == profile
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" in distributions.profile_variables()  # Kilted takes it, too


def test_another_middleware_is_told_of_once_and_has_advice_of_its_own(monkeypatch, capfd):
    def runs(middleware):
        monkeypatch.setattr(distributions, "get_rmw_implementation_identifier", lambda: middleware)

    runs("rmw_cyclonedds_cpp")
    with Peer() as peer:
        points = peer.calibration.sensors.adaptive[1]
        for publisher in (peer.image_pub, peer.cloud_pub):
            peer.peer.destroy_publisher(publisher)
        for middleware, advice, silence in (
            ("rmw_cyclonedds_cpp", "SocketReceiveBufferSize in CYCLONEDDS_URI", "ROS_DOMAIN_ID"),
            ("rmw_zenoh_cpp", "ZENOH_CONFIG_OVERRIDE='transport/shared_memory/enabled=true'", "and that rmw_zenohd runs"),
            ("rmw_connextdds", "socket buffers (net.core.rmem_max) that hold several messages", "ROS_DOMAIN_ID"),
        ):
            runs(middleware)
            peer.until(lambda silence=silence: points.silence.endswith(silence))
            assert advice in loss_advice(points)
            assert "fastdds_profile" not in loss_advice(points)
    assert capfd.readouterr().err.count("rmw_cyclonedds_cpp: to receive large messages, ") == 1


def test_a_middleware_that_reports_no_losses_is_named_once(monkeypatch, capfd, street):
    class Unsupported(distributions.SubscriptionEventCallbacks):
        def create_event_handlers(self, *_):
            raise distributions.UnsupportedEventTypeError("no such event")

    monkeypatch.setattr(subscriptions, "SubscriptionEventCallbacks", Unsupported)
    with Peer(online__mode="manual") as peer:
        peer.drive(street[:2])
        assert peer.pipeline.pairing.synchronizer.counts.pairs == 2
        assert [subscription.lost_share() for subscription in peer.calibration.sensors.adaptive] == [0.0] * 3
    assert capfd.readouterr().err.count("does not report lost messages") == 1


@pytest.mark.skipif(find_spec("cyclonedds") is None, reason="cyclonedds is not installed: no wheel for this Python")
def test_a_driver_on_cyclone_dds_is_received(street_bag, drive, street):
    driver = [sys.executable, Path(__file__).parents[2] / "support/cyclone_driver.py", street_bag]
    start = start_parameters(drive.reference)
    with Peer(**start, reliability="reliable", online__mode="manual") as peer, subprocess.Popen(driver) as process:
        counts = peer.pipeline.pairing.synchronizer.counts
        assert process.wait(120) == 0
        peer.until(lambda: counts.pairs == len(street), "all pairs")
        peer.settle()
        assert (counts.images, counts.clouds) == 2 * (len(street),)
        frame = peer.pipeline.last_keyframe
        assert np.array_equal(frame.image, street[-1].image)
        assert np.array_equal(frame.cloud.xyz, street[-1].cloud.xyz)
        assert peer.pipeline.camera == street[-1].camera

"""Subscriptions that follow their publishers, over real DDS in this process."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from ros_peer import LATCHED, Peer
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Header
from vehicle import Vehicle
from waiting import until

from calib_ros.frame import NANOSECONDS
from calib_ros.messages import decode_cloud
from calib_ros.messages.point_fields import decode_livox
from calib_ros.ros import dds
from calib_ros.ros.distributions import profile_variables
from calib_ros.ros.subscriptions import AdaptiveSubscription, livox_forms, loss_advice, serialized

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
RELIABLE = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)


class Topic:
    """A subscriber's node and a publisher's node on one executor that the test turns by hand."""

    def __init__(self) -> None:
        self.context = Context()
        rclpy.init(context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.listener, self.talker = (rclpy.create_node(name, context=self.context) for name in ("listener", "talker"))
        self.executor.add_node(self.listener)
        self.executor.add_node(self.talker)
        self.got: list[int] = []
        self.sent = 0

    def subscribe(self, preference: str, latched: bool = False, kind: type[Any] = CameraInfo) -> AdaptiveSubscription:
        def receive(stamp: int, msg: Any) -> None:
            self.got.append(msg.message().height)

        return AdaptiveSubscription(self.listener, [serialized(kind)], "info", receive, preference, latched)

    def publisher(self, qos: QoSProfile) -> Any:
        count = self.publishers()
        publisher = self.talker.create_publisher(CameraInfo, "info", qos)
        self.until(lambda: self.publishers() > count)
        return publisher

    def publishers(self) -> int:
        return len(self.listener.get_publishers_info_by_topic("/info"))

    def gone(self, publisher: Any) -> None:
        count = self.publishers()
        self.talker.destroy_publisher(publisher)
        self.until(lambda: self.publishers() < count)

    def send(self, publisher: Any) -> None:
        self.sent += 1
        msg = CameraInfo(height=self.sent)
        msg.header.stamp.sec = self.sent
        publisher.publish(msg)

    def until(self, condition: Callable[[], Any]) -> None:
        until(condition, turn=lambda: self.executor.spin_once(timeout_sec=0.01), state=lambda: f"got {self.got}")

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.01)


@pytest.fixture
def topic():
    topic = Topic()
    yield topic
    topic.executor.shutdown(timeout_sec=1.0)
    topic.listener.destroy_node()
    topic.talker.destroy_node()
    rclpy.try_shutdown(context=topic.context)


def test_auto_follows_the_publishers_as_they_come_and_go(topic):
    subscription = topic.subscribe("auto")

    def follows(reliable: bool) -> bool:
        return subscription.check() == "" and subscription.reliable == reliable

    assert follows(False)
    assert subscription.silence == "/info has no publisher; check the remapping and ROS_DOMAIN_ID"
    first = topic.publisher(RELIABLE)
    assert follows(True)
    assert subscription.silence == "/info is published, but nothing comes; check its driver"
    second = topic.publisher(BEST_EFFORT)
    assert follows(False)
    topic.until(lambda: first.get_subscription_count() and second.get_subscription_count())
    topic.send(first)
    topic.send(second)
    topic.until(lambda: set(topic.got) == {1, 2})
    topic.gone(second)
    assert follows(True)
    topic.gone(first)
    assert follows(True)  # nobody there: nothing to follow


def test_no_message_is_lost_or_doubled_in_a_change(topic):
    subscription = topic.subscribe("auto")
    publisher = topic.publisher(RELIABLE)
    topic.until(lambda: publisher.get_subscription_count() == 1)
    for k in range(150):
        if k in (20, 60, 100):  # to reliable, to best effort, to reliable again
            subscription.preference = ("auto", "best_effort", "reliable")[k // 40]
            assert subscription.check() == ""
            assert subscription.reliable == (k != 60)
        topic.send(publisher)
        topic.spin(0.02)
        if k % 10 == 0:
            subscription.check()
    topic.until(lambda: len(topic.got) >= 150)
    topic.spin(0.2)
    assert topic.got == list(range(1, 151))
    topic.until(lambda: not subscription.check() and publisher.get_subscription_count() == 1)  # the old ones are gone


def test_a_choice_that_cannot_work_is_named(topic):
    subscription = topic.subscribe("reliable")
    topic.publisher(BEST_EFFORT)
    assert "/info offers best effort only and cannot be received; set reliability: auto" in subscription.check()
    subscription.preference = "auto"
    assert subscription.check() == ""


def test_advice_on_losses_names_nothing_that_is_set_already(topic, monkeypatch):
    monkeypatch.setattr(dds, "_set_here", False)
    for name in profile_variables():
        monkeypatch.delenv(name, raising=False)
    subscription = topic.subscribe("best_effort")
    advised = loss_advice(subscription)
    assert re.fullmatch(r"start its driver with FAST\w+=\S+/fastdds_profile_large.xml, or let it publish reliably", advised)
    for profile, text in (
        (dds.config_file(dds.LARGE_PROFILE), "from another computer raise net.core.rmem_max on both, or"),
        (dds.config_file(dds.PROFILE), "fastdds_profile_large.xml, or"),
        ("/own.xml", "let the profile /own.xml hold several messages"),
    ):
        monkeypatch.setenv(profile_variables()[-1], str(profile))
        assert text in loss_advice(subscription)
    topic.publisher(RELIABLE)
    assert subscription.check() == ""
    assert loss_advice(subscription) == "set reliability: auto, since its publishers are reliable"


@contextmanager
def stranger(kind: type[Any], topic: str) -> Iterator[Any]:
    """A publisher of another participant: within one, DDS refuses a second type on a topic."""
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("stranger", context=context)
    yield node.create_publisher(kind, topic, RELIABLE)
    node.destroy_node()
    rclpy.try_shutdown(context=context)


@pytest.fixture
def across_processes(monkeypatch):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


@pytest.mark.parametrize(
    ("wanted", "published", "text"),
    [
        (Image, CompressedImage, "CompressedImage, but sensor_msgs/msg/Image is wanted; set image_transport: compressed"),
        (CompressedImage, Image, "Image, but sensor_msgs/msg/CompressedImage is wanted; set image_transport: raw"),
        (PointCloud2, Image, "Image, but sensor_msgs/msg/PointCloud2 is wanted; check the remapping"),
        (Image, PointCloud2, "PointCloud2, but sensor_msgs/msg/Image is wanted; check the remapping"),
    ],
)
def test_a_topic_of_another_type_is_named(across_processes, topic, wanted, published, text):
    subscription = topic.subscribe("auto", kind=wanted)
    with stranger(published, "info"):
        topic.until(lambda: subscription.check())
        assert subscription.check() == f"/info is published as sensor_msgs/msg/{text}"
    assert not subscription.reliable  # a publisher of another type is not followed


@pytest.mark.parametrize(
    ("wanted", "published", "text"),
    [
        (PointCloud2, "livox_interfaces/msg/CustomMsg", "source the driver's workspace"),
        (PointCloud2, "point_cloud_interfaces/msg/CompressedPointCloud2", "point_cloud_transport republish"),
        (Image, "foxglove_msgs/msg/CompressedVideo", "image_transport republish"),
        (CompressedImage, "ffmpeg_image_transport_msgs/msg/FFMPEGPacket", "image_transport republish"),
        (CameraInfo, "sensor_msgs/msg/Image", "check the remapping"),
    ],
)
def test_what_drivers_publish_else_has_its_own_advice(topic, wanted, published, text):
    assert text in AdaptiveSubscription(topic.listener, [serialized(wanted)], "other", print, "auto")._problem([published], [])


def test_clouds_of_livox_are_received_while_nobody_publishes_usual_ones(across_processes, topic):
    messages = pytest.importorskip("livox_ros_driver2.msg", reason="livox_ros_driver2 is not installed")
    clouds: list[tuple[int, Any]] = []
    forms = [serialized(PointCloud2), *livox_forms()]
    subscription = AdaptiveSubscription(
        topic.listener, forms, "info", lambda stamp, msg: clouds.append((stamp, msg.message())), "auto"
    )

    def arrives(publisher: Any, message: Any, count: int) -> Any:
        topic.until(lambda: subscription.check() == "" and publisher.get_subscription_count() == 1)
        topic.until(lambda: publisher.publish(message) or (clouds and clouds[-1][1].width == count))
        assert clouds[-1][0] == 7 * NANOSECONDS
        return clouds[-1][1]

    points = [
        messages.CustomPoint(offset_time=5_000_000 * k, x=float(k), y=2.0, z=3.0, reflectivity=200, line=k) for k in range(3)
    ]
    scan = messages.CustomMsg(header=Header(stamp=Time(sec=7), frame_id="livox_frame"), point_num=3, points=points)
    with stranger(messages.CustomMsg, "info") as publisher:
        msg = arrives(publisher, scan, 3)
        assert msg.header.frame_id == "livox_frame"
        cloud, read = decode_cloud(msg), decode_livox(serialize_message(scan))
        for name in ("xyz", "intensity", "ring", "time"):
            assert np.array_equal(getattr(cloud, name), getattr(read, name))
        assert np.allclose(cloud.time, [0, 0.005, 0.01])
        assert list(cloud.ring) == [0, 1, 2]
    with stranger(PointCloud2, "info") as publisher:  # the driver was started again, with another format
        arrives(publisher, PointCloud2(header=scan.header), 0)
    with stranger(messages.CustomMsg, "info") as publisher:
        arrives(publisher, scan, 3)


def test_latched_messages_are_received(topic):
    publisher = topic.publisher(LATCHED)
    topic.send(publisher)
    subscription = topic.subscribe("auto", latched=True)
    subscription.check()
    topic.until(lambda: topic.got == [1])


def test_the_node_becomes_reliable_and_loses_nothing(street, drive):
    with Peer(initial_from_tf=False, online__mode="manual") as peer:
        vehicle = Vehicle(peer, street, drive.reference)
        sent = count()
        reliable = lambda: "/points" in peer.values.get("reliable topics", "")  # noqa: E731
        until(reliable, "reliable subscriptions", lambda: peer.publish(vehicle.frame()) or next(sent))
        peer.drive(vehicle.frame() for _ in range(4))
        number, counts = next(sent) + 4, peer.pipeline.pairing.synchronizer.counts
        assert (counts.images, counts.clouds, counts.pairs) == 3 * (number,)
        assert all(subscription.reliable for subscription in peer.calibration.sensors.adaptive)
        assert peer.calibration.sensors.adaptive[1]._forms[1:] == livox_forms()  # whose clouds it takes as well
        assert peer.new_values()["share of images paired"] == "1.00"
        assert peer.calibration.health.errors == 0

"""A camera and a LiDAR of a rig, as the node of a single pair sees them: each message is received and decoded once for all."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.parameter import Parameter

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.recent import Recent
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud
from calib_ros.messages import stamp_ns
from calib_ros.online.common import Common
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.rig.description import CAMERA, RigDescription
from calib_ros.rig.edges import SEEN, seen_share
from calib_ros.rig.live import Pair
from calib_ros.ros.conversions import Serialized, cloud_from_message, pixels_from_message
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.subscriptions import AdaptiveSubscription, Form

TOKEN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")  # of the name of a node
# Settings of a node of one pair that a rig has in another way, or a pair each by itself.
OF_RIG = {"rig_file", "publish_tf", "tf_parent", "tf_child", "export.on_converged", "export.joint"}
OF_PAIR = {"camera_frame", "lidar_frame", "initial_translation_m", "initial_quaternion_xyzw", "state_file", "capture_dir"}
USED = {"rig_file", "publish_tf", "export.on_converged", "state_file", "capture_dir"}  # of these, by the rig as well
Guard = Callable[[], AbstractContextManager[None]]
CLOUDS_KEPT, IMAGES_KEPT = 6, 2  # decoded messages: of clouds, those before a keyframe's are asked for as well
UNSEEN_SCANS = 10  # one after the other without a point in view: a second
CHECKED_AGAIN_S = 0.5  # everybody who listens checks once a second


def camera_pairs(description: RigDescription, path: str) -> list[Pair]:
    """Cameras and LiDARs to be estimated. BadInputError for names that no topic may have, or a rig without such pairs."""
    for sensor in description.sensors:
        if not TOKEN.fullmatch(sensor.name):
            raise BadInputError(f"{path}: sensors.{sensor.name} cannot be part of a topic's name; use letters, digits and _")
    given = description.pairs
    found = list(product(description.cameras, description.lidars)) if given is None else list(given)
    found = [(a, b) for a, b in found if description[a].kind == CAMERA]
    if not found:
        raise BadInputError(f"{path}: pairs holds no camera with a LiDAR, which the node estimates; add one")
    return found


def lidar_pairs(description: RigDescription) -> list[Pair]:
    """Two LiDARs to be registered to each other."""
    if description.pairs is None:
        return list(combinations(description.lidars, 2))
    return [(a, b) for a, b in description.pairs if description[a].kind != CAMERA]


def node_of_pair(
    node: Node, given: Parameters, description: RigDescription, pair: Pair, known: tuple[Transform, SearchBox] | None
) -> Node:
    """A node of a pair, below that of the rig: what is remapped or renamed on the command line is the rig's.

    given: parameters of the rig, which are the pair's but for what is its own. known: T_camera_lidar (4, 4) by the description,
    and how far around to search.
    """
    overrides, (camera, lidar) = node._parameter_overrides, pair
    own: dict[str, Any] = {"camera_frame": description[camera].frame, "lidar_frame": description[lidar].frame}
    if description[camera].mask:
        own["image.mask"] = description[camera].mask
    if known is not None:
        T, box = known
        own["initial_translation_m"] = T[:3, 3].tolist()
        own["initial_quaternion_xyzw"] = se3.quaternion_from_rotation(T[:3, :3]).tolist()
        own["search.rotation_deg"], own["search.translation_m"] = np.max(box.rotation_deg), np.max(box.translation_m)
        own |= {name: overrides[name].value for name in ("search.rotation_deg", "search.translation_m") if name in overrides}
    if path := given["state_file"]:
        stem, dot, ending = path.rpartition(".")
        own["state_file"] = f"{stem}.{camera}.{lidar}.{ending}" if dot else f"{path}.{camera}.{lidar}"
    if folder := given["capture_dir"]:
        own["capture_dir"] = f"{folder}/{camera}/{lidar}"
    of_all = [n for n in overrides if n in node._parameters and n not in OF_RIG | OF_PAIR and n not in own]
    return Node(
        lidar,
        context=node.context,
        namespace=f"{node.get_fully_qualified_name()}/{camera}",
        use_global_arguments=False,
        parameter_overrides=[overrides[n] for n in of_all] + [Parameter(n, value=v) for n, v in own.items()],
        allow_undeclared_parameters=True,
    )


class SharedTopics:
    """Subscriptions of one node that several listen to, each with a callback of its own."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._topics: dict[str, _Topic] = {}

    def subscribe(
        self, forms: Sequence[Form], topic: str, callback: Callable[[int, Any], None], guard: Guard = nullcontext, **options: Any
    ) -> Listener:
        """As an `AdaptiveSubscription`, which the first one makes with its options."""
        if topic not in self._topics:
            make = partial(AdaptiveSubscription, self.node, forms, topic, guard=guard, **options)
            self._topics[topic] = _Topic(make)
        return Listener(self._topics[topic], callback, guard, self._leave)

    def _leave(self, topic: _Topic) -> None:
        topic.subscription.destroy()
        self._topics = {name: own for name, own in self._topics.items() if own is not topic}


class _Topic:
    def __init__(self, make: Callable[..., AdaptiveSubscription]) -> None:
        self.listeners: list[Listener] = []
        self.checked, self.problem = 0.0, ""
        self.subscription = make(callback=self._receive)

    def _receive(self, stamp: int, message: Any) -> None:
        for listener in list(self.listeners):
            with listener.guard():
                listener.callback(stamp, message)


class Listener:
    """One of those who share a subscription, with the members of an `AdaptiveSubscription`."""

    def __init__(
        self,
        topic: _Topic,
        callback: Callable[[int, Any], None],
        guard: Guard,
        leave: Callable[[_Topic], None],
    ) -> None:
        self._topic, self.callback, self.guard, self._leave = topic, callback, guard, leave
        self.preference = topic.subscription.preference
        topic.listeners.append(self)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._topic.subscription, name)

    @property
    def tells(self) -> bool:
        """See `AdaptiveSubscription`: of those who share it, the first one."""
        return self._topic.listeners[:1] == [self]

    def check(self) -> str:
        """See `AdaptiveSubscription`."""
        own, now = self._topic, time.monotonic()
        if now - own.checked >= CHECKED_AGAIN_S:
            own.checked, own.subscription.preference = now, self.preference
            own.problem = own.subscription.check()
        return own.problem

    def destroy(self) -> None:
        """Receive nothing any more; the last one ends the subscription."""
        if self in self._topic.listeners:
            self._topic.listeners.remove(self)
            if not self._topic.listeners:
                self._leave(self._topic)


class Decoded:
    """What the messages of one sensor hold, decoded once for all who ask."""

    def __init__(self, decode: Callable[[Serialized], Any], kept: int) -> None:
        self._decode, self._recent = decode, Recent(kept)

    def __call__(self, message: Serialized) -> Any:
        return self._recent(message, lambda: self._decode(message))


def decoded_clouds() -> Decoded:
    """Of a LiDAR."""
    return Decoded(cloud_from_message, CLOUDS_KEPT)


def decoded_images() -> Decoded:
    """Of a camera."""
    return Decoded(pixels_from_message, IMAGES_KEPT)


@dataclass(eq=False)
class PairOfRig:
    """What a pair's interface takes from its rig.

    camera, lidar: names. topics: of image, points and CameraInfo. T: T_camera_lidar (4, 4) by the priors; None = unknown. unseen:
    called with a line for people where no point of a scan is in view by it; None: not to be asked, the pair is given. on_reset:
    called after ~/reset of the pair.
    """

    camera: str
    lidar: str
    common: Common
    shared: SharedTopics
    topics: tuple[str, str, str]
    image: Decoded
    cloud: Decoded
    T: Transform | None = None
    unseen: Callable[[str], None] | None = None
    on_reset: Callable[[], None] = lambda: None
    _unseen_scans: int = 0

    def frame(self, image: Serialized, cloud: Serialized, camera: Camera) -> Frame:
        """Image and cloud -> Frame. BadInputError if one of them cannot be decoded, or shows nothing of the other."""
        points: PointCloud = self.cloud(cloud)
        if self.unseen is not None and self.T is not None:
            if seen_share(camera, self.T, points.finite().xyz.astype(float)) >= SEEN:
                self.unseen = None
            else:
                self._unseen_scans += 1  # a LiDAR that starts may send parts of scans
                line = f"{self.camera} and {self.lidar} share no view by their priors, and are not estimated"
                if self._unseen_scans >= UNSEEN_SCANS:
                    self.unseen(line)
                raise BadInputError(line)
        pixels: NDArray[np.uint8] = self.image(image)
        return Frame(pixels, points, camera, stamp_ns(image.header.stamp), stamp_ns(cloud.header.stamp))

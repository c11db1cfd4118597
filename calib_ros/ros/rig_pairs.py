"""A camera and a LiDAR of a rig, as the node of a single pair sees them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.parameter import Parameter

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud
from calib_ros.messages import stamp_ns
from calib_ros.online.common import Common
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.rig.description import CAMERA, RigDescription
from calib_ros.rig.edges import SEEN, seen_share
from calib_ros.rig.live import Pair
from calib_ros.ros.conversions import Serialized
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.shared_topics import Decoded, SharedTopics

TOKEN = re.compile(r"[A-Za-z][A-Za-z0-9_]*")  # of the name of a node
# Settings of a node of one pair that a rig has in another way, or a pair each by itself.
OF_RIG = {"rig_file", "publish_tf", "tf_parent", "tf_child", "export.on_converged", "export.joint"}
OF_PAIR = {"camera_frame", "lidar_frame", "initial_translation_m", "initial_quaternion_xyzw", "state_file", "capture_dir"}
USED = {"rig_file", "publish_tf", "export.on_converged", "state_file", "capture_dir"}  # of these, by the rig as well
UNSEEN_SCANS = 10  # one after the other without a point in view: a second


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

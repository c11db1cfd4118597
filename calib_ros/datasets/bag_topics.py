"""Which topics of a bag are the camera's image, its CameraInfo and the LiDAR's cloud."""

from __future__ import annotations

import re

from calib_ros.datasets.bag_file import BagFile
from calib_ros.errors import BadInputError

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINTS = "sensor_msgs/msg/PointCloud2"


def choose_image(bag: BagFile, wanted: str | None) -> str:
    """The image topic: the wanted one, or the only one. A raw image wins over its compressed transport."""
    candidates = _with_type(bag, IMAGE, COMPRESSED)
    if wanted is None:
        candidates = [name for name in candidates if not name.endswith("/compressedDepth")]
        transports = {f"{name}/compressed" for name in candidates}
        candidates = [name for name in candidates if name not in transports]
    return _choose(bag, wanted, candidates, "Image or CompressedImage", "image_topic")


def choose_points(bag: BagFile, wanted: str | None) -> str:
    """The cloud topic: the wanted one, or the only one."""
    return _choose(bag, wanted, _with_type(bag, POINTS), "PointCloud2", "points_topic")


def choose_camera_info(bag: BagFile, wanted: str | None, image_topic: str) -> str:
    """The wanted CameraInfo topic, or the one beside the image (image_transport's rule), or the only one."""
    candidates = _with_type(bag, CAMERA_INFO)
    beside = re.sub(r"/compressed$", "", image_topic).rpartition("/")[0] + "/camera_info"
    if wanted is None and beside in candidates:
        return beside
    return _choose(bag, wanted, candidates, "CameraInfo", "camera_info_topic")


def is_rectified(image_topic: str) -> bool:
    """Whether a topic is rectified by image_proc's naming (image_rect, image_rect_color)."""
    return re.search(r"(^|[/_])rect(ified)?($|[/_])", image_topic) is not None


def _with_type(bag: BagFile, *types: str) -> list[str]:
    return [topic.name for topic in bag.topics.values() if topic.type in types and topic.messages > 0]


def _choose(bag: BagFile, wanted: str | None, candidates: list[str], kind: str, option: str) -> str:
    if wanted is not None:
        name = "/" + wanted.strip("/")
        if name in candidates:
            return name
        has = f"it has {', '.join(candidates)}" if candidates else "it has none"
        raise BadInputError(f"bag {bag.path} has no {kind} messages on topic {name}; {has}; set {option} accordingly")
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise BadInputError(
            f"bag {bag.path} has {len(candidates)} topics of type {kind}: {', '.join(candidates)}; choose one with {option}"
        )
    others = ", ".join(f"{topic.name} ({topic.type})" for topic in bag.topics.values()) or "nothing at all"
    raise BadInputError(f"bag {bag.path} has no {kind} messages, only {others}; record that topic too")

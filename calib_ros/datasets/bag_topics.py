"""Which topics of a bag hold the images, their CameraInfo, and the clouds."""

from __future__ import annotations

import re

from calib_ros.datasets.bag_file import BagFile
from calib_ros.errors import BadInputError
from calib_ros.messages.compressed_points import COMPRESSED_POINTS, REPUBLISH
from calib_ros.messages.point_fields import LIVOX
from calib_ros.messages.video import VIDEO
from calib_ros.messages.wire import shown

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINTS = "sensor_msgs/msg/PointCloud2"
# Types that hold images or clouds in a form that is not read, and what makes one that is.
REMEDIES = {
    "VelodyneScan": "play the bag, run the transform node of velodyne_pointcloud for your model, and record its cloud",
    "PacketMsg": "play the bag, run the cloud node of ouster_ros, and record its cloud",
    "CompressedPointCloud2": REPUBLISH,  # of other packages
    "LaserScan": "a scan of one plane has no edges to calibrate by; record a 3-D LiDAR",
}
MOST_NAMED = 40  # topics that an error names
SEVERAL = ("--image-topic", "--points-topic")  # options that choose one of a rig's sensors
DEPTH = "/compressedDepth"  # how image_transport names the topics of depth images


def choose_image(bag: BagFile, requested: str | None, option: str = "--image-topic") -> str:
    """The image topic: the requested one, or the only one. A raw image wins over its compressed transport. option: what to set,
    if it is not there."""
    candidates = pictures(bag) if requested is None else _with_type(bag, IMAGE, COMPRESSED, *VIDEO)
    return _choose(bag, requested, candidates, "Image, CompressedImage or video", option)


def pictures(bag: BagFile) -> list[str]:
    """Topics of images, but for depth images and further forms of the same topic; of video where there are no others."""
    found = _with_type(bag, IMAGE, COMPRESSED)
    transports = {f"{name}/compressed" for name in found}
    return [name for name in found if not name.endswith(DEPTH) and name not in transports] or _with_type(bag, *VIDEO)


def choose_points(bag: BagFile, requested: str | None, option: str = "--points-topic") -> str:
    """The cloud topic: the requested one, or the only one. option: what to set, if it is not there."""
    candidates = clouds(bag) if requested is None else _with_type(bag, POINTS, *LIVOX, COMPRESSED_POINTS)
    return _choose(bag, requested, candidates, "PointCloud2", option)


def clouds(bag: BagFile) -> list[str]:
    """Topics of scanners, in other forms where there is no PointCloud2."""
    return _with_type(bag, POINTS) or _with_type(bag, *LIVOX, COMPRESSED_POINTS)


def choose_camera_info(bag: BagFile, requested: str | None, image_topic: str, option: str = "--camera-info-topic") -> str:
    """The requested CameraInfo topic, or the one beside the image (image_transport's rule), or the only one. option: what to set,
    if it is not there."""
    if requested is None and (found := info_beside(bag, image_topic)):
        return found
    return _choose(bag, requested, _with_type(bag, CAMERA_INFO), "CameraInfo", option)


def info_beside(bag: BagFile, image_topic: str) -> str:
    """The CameraInfo topic that image_transport looks for; "" if the bag has none there."""
    name = re.sub(r"/(compressed|ffmpeg|foxglove)$", "", image_topic).rpartition("/")[0] + "/camera_info"
    return name if name in _with_type(bag, CAMERA_INFO) else ""


def is_rectified(image_topic: str) -> bool:
    """Whether the name of a topic says rectified, as image_proc names them (image_rect, image_rect_color)."""
    return re.search(r"(^|[/_])rect(ified)?($|[/_])", image_topic) is not None


def _with_type(bag: BagFile, *types: str) -> list[str]:
    return [topic.name for topic in bag.topics.values() if topic.type in types and topic.messages > 0]


def _choose(bag: BagFile, requested: str | None, candidates: list[str], kind: str, option: str) -> str:
    if requested is not None:
        name = "/" + requested.strip("/")
        for own in (name, name[1:]):  # topics of ROS 1 may have no slash
            if own in candidates:
                return own
        has = f"it has {_named(candidates)}" if candidates else "it has none"
        raise BadInputError(f"bag {bag.path} has no {kind} messages on topic {name}; {has}; set {option} accordingly")
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise BadInputError(
            f"bag {bag.path} has {len(candidates)} topics of type {kind}: {_named(candidates)}; choose one with {option}"
            + (", or estimate all sensors together with calib-ros rig" if option in SEVERAL else "")
        )
    others = _named([f"{topic.name} ({topic.type})" for topic in bag.topics.values()]) or "nothing at all"
    names = dict.fromkeys(topic.type.rpartition("/")[2] for topic in bag.topics.values() if topic.messages)
    advice = [f"{name}: {REMEDIES[name]}" for name in names if name in REMEDIES]
    if kind.startswith("Image"):
        advice[:0] = [f"{shown(topic)} is a depth image, no camera picture" for topic in bag.topics if topic.endswith(DEPTH)]
    raise BadInputError(f"bag {bag.path} has no {kind} messages, only {others}; {'; '.join(advice) or 'record that topic too'}")


def _named(topics: list[str]) -> str:
    return ", ".join([*(" ".join(topic.split()) for topic in topics[:MOST_NAMED]), *["..."] * (len(topics) > MOST_NAMED)])

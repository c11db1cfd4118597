"""One pass over a bag's headers: what is needed to pair its messages and to fetch them again one by one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.nearest import Stamps, nearest_index
from calib_ros.datasets.static_transforms import StaticTransforms
from calib_ros.errors import BadInputError
from calib_ros.messages import decode_camera_info

TF = "tf2_msgs/msg/TFMessage"
Matrix = NDArray[np.float64]


class TopicIndex:
    """Where the messages of one topic are.

    After `finish`, sorted by stamp, all in ns: stamps (n,), the stamps in the headers (n,) and the times of
    recording (n,).
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.frame = ""
        self._found: list[tuple[int, int]] = []  # stamp of the header, time of recording

    def add(self, recorded: int, data: bytes) -> None:
        """Note a message's header."""
        if len(data) < 16:
            raise BadInputError(f"a message has only {len(data)} bytes; record the bag anew")
        header, frame = peek_header(data)
        self.frame = self.frame or frame
        self._found.append((header, recorded))

    def __len__(self) -> int:
        return len(self._found)

    @property
    def has_stamps(self) -> bool:
        """Whether any header has a stamp; drivers without a clock leave zeros."""
        return any(header for header, _ in self._found)

    def finish(self, use_headers: bool) -> None:
        """Sort by stamp: the header's, or else the time of recording."""
        headers, recorded = np.array(self._found, np.int64).reshape(-1, 2).T
        stamps = headers if use_headers else recorded
        self.order = np.argsort(stamps, kind="stable")
        self.stamps: Stamps = stamps[self.order]
        self.headers: Stamps = headers[self.order]
        self.recorded: Stamps = recorded[self.order]


class BagIndex:
    """Images, clouds, cameras and static transforms of a bag.

    Reads all of it once and keeps some tens of bytes per message.
    """

    def __init__(self, bag: BagFile, image_topic: str, points_topic: str, info_topic: str, rectified: bool) -> None:
        self.image, self.cloud, self.info = (TopicIndex(topic) for topic in (image_topic, points_topic, info_topic))
        by_topic = {index.topic: index for index in (self.image, self.cloud, self.info)}
        statics = [t.name for t in bag.topics.values() if t.type == TF and t.name.endswith("/tf_static")]
        decoded: dict[bytes, Camera] = {}
        cameras: list[Camera] = []
        transforms: list[tuple[int, Any]] = []
        for topic, recorded, data in bag.raw([*by_topic, *statics]):
            if topic in statics:
                transforms.append((recorded, bag.decode(topic, data)))
                continue
            with naming(bag.path, topic):
                by_topic[topic].add(recorded, data)
                if topic == info_topic:
                    content = bytes(data[12:])  # all but the stamp: nearly always the same, so decoded once
                    if content not in decoded:
                        decoded[content] = decode_camera_info(bag.decode(topic, data), rectified)
                    cameras.append(decoded[content])
        for index in by_topic.values():
            if not len(index):
                raise BadInputError(f"bag {bag.path}: no message on {index.topic} is readable; copy it again or record anew")
        self.use_headers = self.image.has_stamps and self.cloud.has_stamps
        for index in by_topic.values():
            index.finish(self.use_headers)
        self.camera_frame = self.image.frame or self.info.frame
        self.lidar_frame = self.cloud.frame
        self._cameras: list[Camera] = [cameras[i] for i in self.info.order]
        self._references = _references(transforms, self.camera_frame, self.lidar_frame)

    def camera_at(self, stamp: int) -> Camera:
        """The camera of the CameraInfo nearest to an image's stamp."""
        return self._cameras[int(nearest_index(self.info.stamps, np.array([stamp]))[0])]

    def reference_at(self, recorded: int) -> Matrix | None:
        """T_camera_lidar (4, 4) as known at a time of recording, None if never.

        Frames recorded before the first transform arrived have the first one.
        """
        if not self._references:
            return None
        known = sum(time <= recorded for time, _ in self._references)
        return self._references[max(known - 1, 0)][1]


def _references(transforms: list[tuple[int, Any]], camera_frame: str, lidar_frame: str) -> list[tuple[int, Matrix]]:
    """T_camera_lidar after each static transform message that changed it, with the time of recording."""
    tree = StaticTransforms()
    known: list[tuple[int, Matrix]] = []
    for recorded, message in transforms:
        tree.add(message)
        T = tree.lookup(camera_frame, lidar_frame)
        if T is not None and not (known and np.array_equal(T, known[-1][1])):
            known.append((recorded, T))
    return known


@contextmanager
def naming(path: Path, where: str) -> Iterator[None]:
    """Say in which bag and where in it an unusable message was met."""
    try:
        yield
    except BadInputError as error:
        raise BadInputError(f"{path}, {where}: {error}") from error

"""The sensors of a description in a bag."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.bag import BagSource, cloud_of
from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.bag_index import RECORDING, BagListing
from calib_ros.datasets.bag_topics import (
    choose_camera_info,
    choose_image,
    choose_points,
    clouds,
    info_beside,
    is_rectified,
    pictures,
)
from calib_ros.datasets.recent import Timed
from calib_ros.datasets.rig import CAMERA, LIDAR, DescribedRig, RigDescription, Sensor, ros_name
from calib_ros.datasets.static_transforms import StaticTransforms
from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros.messages import decode_camera_info

# Parts of topics that say what a message is, not of which sensor.
NO_NAME = re.compile(r"(image|points?|point_?cloud2?|cloud|scan|raw|rect|rectified|colou?r|mono|bgr|rgb|compressed|ffmpeg|_)*")
NO_SENSORS = {"base_link", "base_footprint", "odom", "map", "earth"}  # frames of REP 105


class BagRig(DescribedRig):
    """The sensors of a description in a bag, by their topics. options: of `BagSource`."""

    def __init__(self, path: Path, description: RigDescription, **options: Any) -> None:
        super().__init__(path.resolve().stem if path.is_file() else path.resolve().name, description)
        self.path, self._options = path, options
        self._bag = BagFile(path, bool(options.get("incomplete")))
        self._topics = {}
        for name, sensor in self.sensors.items():
            choose = choose_image if sensor.kind == CAMERA else choose_points
            self._topics[name] = choose(self._bag, sensor.topic or None, f"sensors.{name}.topic")

    def camera(self, name: str) -> Camera:
        """By the first CameraInfo."""
        topic = self._info_topic(name)
        message = self._bag.decode(topic, self._first(topic))
        rectified = self._options.get("rectified")
        return decode_camera_info(message, is_rectified(self._topics[name]) if rectified is None else rectified)

    def frame_id(self, name: str) -> str:
        """That of the description, else of the messages."""
        return self.sensors[name].frame or peek_header(self._first(self._topics[name]))[1]

    def reference(self, name: str) -> Transform | None:
        """By the static transforms of the bag."""
        return self._tree.lookup(self.frame_id(self.reference_sensor), self.frame_id(name))

    def open_pair(self, camera: Sensor, lidar: Sensor) -> BagSource:
        """The priors say where about the camera looks."""
        of_camera, of_lidar = self._believed(camera.name), self._believed(lidar.name)
        view = None if of_camera is None or of_lidar is None else se3.inverse(of_camera) @ of_lidar
        topics = self._topics[camera.name], self._topics[lidar.name], self._info_topic(camera.name)
        of_all: dict[str, Any] = {} if self._options.get("windows") else {"listing": self._listing}
        clock = {} if self._by_headers else {"clock": RECORDING}
        return BagSource(self.path, *topics, **{"T_camera_lidar": view, **self._options, **clock, **of_all})

    def scans(self, lidar: str) -> Timed:
        """By the clock of the pairs, differences between clocks not taken out."""
        index = copy(self._listing.found[self._topics[lidar]])
        index.finish(self._by_headers)

        def read(k: int) -> PointCloud:
            kind = self._bag.topics[index.topic].type
            return self._recent(index.key(k), lambda: cloud_of(self._bag.find(*index.key(k)), kind))

        return Timed(index.stamps, read)

    @cached_property
    def _listing(self) -> BagListing:
        """All messages, read once for all pairs."""
        infos = []
        for name in self.cameras:
            with suppress(BadInputError):  # told when the camera is asked for
                infos.append(self._info_topic(name))
        listing = BagListing(self._bag, self._topics.values(), infos)
        listing.read()
        return listing

    @property
    def _by_headers(self) -> bool:
        """Whether the headers' stamps count, which needs them of all sensors: else the times of recording do."""
        measured = (self._listing.found[topic] for topic in self._topics.values())
        return self._options.get("clock") != RECORDING and all(own.has_stamps for own in measured)

    @cached_property
    def _tree(self) -> StaticTransforms:
        tree = StaticTransforms()
        for _, message in self._bag.transforms():
            tree.add(message)
        return tree

    def _believed(self, name: str) -> Transform | None:
        prior = np.eye(4) if name == self.reference_sensor else self.sensors[name].prior
        return self.reference(name) if prior is None else prior

    def _info_topic(self, camera: str) -> str:
        wanted, option = self.sensors[camera].camera_info or None, f"sensors.{camera}.camera_info"
        return choose_camera_info(self._bag, wanted, self._topics[camera], option)

    def _first(self, topic: str) -> bytes:
        for _, _, data in self._bag.raw([topic]):
            return data
        raise BadInputError(f"bag {self.path}: no message on {topic}; record it again, or leave the sensor out")


def bag_sensors(path: Path) -> tuple[list[Sensor], list[str]]:
    """A sensor for every frame that messages come from: of the topics of one frame, the rectified image and the densest cloud.
    Remarks say which topics are left out."""
    bag = BagFile(path)
    images = pictures(bag)
    first = {topic: data for own in (*images, *clouds(bag)) for topic, _, data in islice(bag.raw([own]), 1)}
    frames = {topic: peek_header(data)[1] for topic, data in first.items()}
    infos = {topic: info_beside(bag, topic) for topic in images}
    if len(images) == 1:
        infos[images[0]] = choose_camera_info(bag, None, images[0])
    left = {topic: "no CameraInfo is beside it" for topic in images if not infos[topic]}
    left |= {t: f"{frame} is no frame of a sensor, as merged clouds have" for t, frame in frames.items() if frame in NO_SENSORS}
    best: dict[tuple[bool, str], str] = {}  # topic of what comes from a frame
    for topic in sorted(first.keys() - left.keys(), key=lambda t: (is_rectified(t) if t in images else len(first[t]), t)):
        of = topic in images, frames[topic] or topic
        if of in best:
            left[best[of]] = f"{topic} is of the same frame"
        best[of] = topic
    kept = [topic for topic in first if topic not in left]
    kept.sort(key=lambda topic: (topic in images, topic))
    names, used = _names(kept), Counter(frames[topic] for topic in kept)
    own = {topic: frames[topic] if used[frames[topic]] == 1 else "" for topic in kept}  # "" as recorded
    sensors = [Sensor(names[t], CAMERA if t in images else LIDAR, t, infos.get(t, ""), own[t]) for t in kept]
    return sensors, [f"{topic} is left out: {why}" for topic, why in left.items()]


def _names(topics: Sequence[str]) -> dict[str, str]:
    """'/front/image_raw' -> 'front'; names that differ, of which each can be part of a topic's."""
    named: dict[str, str] = {}
    for topic in topics:
        parts = [part for part in topic.split("/") if part and not NO_NAME.fullmatch(part)]
        names = "_".join(parts) or topic, topic, *(f"{topic}_{k}" for k in range(2, len(topics) + 2))
        named[topic] = next(own for own in map(ros_name, names) if own not in named.values())
    return named

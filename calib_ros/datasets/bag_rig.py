"""The sensors of a description in a bag."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.bag import BagSource, cloud_of
from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.bag_index import RECORDING, TopicIndex
from calib_ros.datasets.bag_topics import choose_camera_info, choose_image, choose_points, is_rectified
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.rig_source import CAMERA, KEPT_CLOUDS, ByDescription, RigDescription
from calib_ros.datasets.static_transforms import StaticTransforms
from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros.messages import decode_camera_info


class BagRig(ByDescription):
    """The sensors of a description in a bag, by their topics. options: of `BagSource`."""

    def __init__(self, path: Path, description: RigDescription, **options: Any) -> None:
        super().__init__(path.resolve().stem if path.is_file() else path.resolve().name, description)
        self.path, self._options, self._recent = path, options, Recent(KEPT_CLOUDS)
        self._bag = BagFile(path, bool(options.get("incomplete")))
        self._topics = {}
        for name, sensor in self.sensors.items():
            choose = choose_image if sensor.kind == CAMERA else choose_points
            self._topics[name] = choose(self._bag, sensor.topic or None, f"sensors.{name}.topic")
        self._pairs: dict[tuple[str, str], BagSource] = {}

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

    def pair(self, camera: str, lidar: str) -> BagSource:
        """As of any rig; the priors say where about the camera looks."""
        if (camera, lidar) not in self._pairs:
            of_camera, of_lidar = self._believed(camera), self._believed(lidar)
            view = None if of_camera is None or of_lidar is None else se3.inverse(of_camera) @ of_lidar
            topics = self._topics[camera], self._topics[lidar], self._info_topic(camera)
            clock = {} if self._indices[1] else {"clock": RECORDING}
            source = BagSource(self.path, *topics, **{"T_camera_lidar": view, **self._options, **clock})
            source.recent = self._recent
            self._pairs[camera, lidar] = source
        return self._pairs[camera, lidar]

    def scans(self, lidar: str) -> Timed:
        """By the clock of the pairs, differences between clocks not taken out."""
        index = self._indices[0][self._topics[lidar]]

        def read(k: int) -> PointCloud:
            name = index.topic, int(index.recorded[k]), int(index.headers[k])
            return self._recent(name, lambda: cloud_of(self._bag.find(*name), self._bag.topics[index.topic].type))

        return Timed(index.stamps, read)

    @cached_property
    def _indices(self) -> tuple[dict[str, TopicIndex], bool]:
        """Of all sensors' messages, by topic; and whether the headers' stamps count, which needs them of all sensors: else the
        times of recording do."""
        found = {topic: TopicIndex(topic) for topic in self._topics.values()}
        for topic, recorded, data in self._bag.heads(list(found), []):
            found[topic].add(recorded, data)
        by_headers = self._options.get("clock") != RECORDING and all(own.has_stamps for own in found.values())
        for index in found.values():
            index.finish(by_headers)
        return found, by_headers

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

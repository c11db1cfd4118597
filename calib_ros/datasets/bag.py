"""A ROS 2 bag as a sequence of synchronised frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.datasets import bag_topics
from calib_ros.datasets.bag_file import BagFile, peek_header
from calib_ros.datasets.bag_index import BagIndex, TopicIndex, naming
from calib_ros.datasets.nearest import nearest_index, nearest_pairs
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.messages import decode_cloud, decode_compressed_image, decode_image


class BagSource:
    """Frames of one camera and one LiDAR in a bag: images and clouds paired by nearest header stamps.

    Opening reads through the bag once for its headers (at the disk's speed); `source[i]` fetches its two
    messages by their time of recording. Topics are found by type when there is one of each. Not for several
    threads at once.

    tolerance_s: an image and a cloud farther apart are no pair.
    rectified: whether the images are rectified, so that CameraInfo's P counts; None: if the topic's name
    says so.
    camera, reference: of the first frame. Each frame has the CameraInfo nearest to it and T_camera_lidar
    from the static transforms as they stood then, None if they do not connect the two frames.
    BadInputError: no or several candidates for a topic, nothing pairs, a damaged bag or message.
    """

    def __init__(
        self,
        path: str | Path,
        image_topic: str | None = None,
        points_topic: str | None = None,
        camera_info_topic: str | None = None,
        tolerance_s: float = 0.05,
        rectified: bool | None = None,
    ) -> None:
        if not 0 <= tolerance_s < 1e6:
            raise BadInputError(f"tolerance_s is {tolerance_s}, but must be 0 or more seconds")
        self.path = Path(path)
        self.name = self.path.resolve().stem if self.path.is_file() else self.path.resolve().name
        self._bag = BagFile(self.path)
        self.image_topic = bag_topics.choose_image(self._bag, image_topic)
        self.points_topic = bag_topics.choose_points(self._bag, points_topic)
        self.camera_info_topic = bag_topics.choose_camera_info(self._bag, camera_info_topic, self.image_topic)
        self.rectified = bag_topics.is_rectified(self.image_topic) if rectified is None else rectified
        self._index = BagIndex(self._bag, self.image_topic, self.points_topic, self.camera_info_topic, self.rectified)
        self.camera_frame, self.lidar_frame = self._index.camera_frame, self._index.lidar_frame
        image, cloud = self._index.image, self._index.cloud
        self._pairs = nearest_pairs(image.stamps, cloud.stamps, round(tolerance_s * NANOSECONDS))
        if not len(self):
            gaps = np.abs(cloud.stamps[nearest_index(cloud.stamps, image.stamps)] - image.stamps)
            raise BadInputError(
                f"bag {self.path}: no message of {self.points_topic} within {tolerance_s:g} s of one of "
                f"{self.image_topic} (the nearest is {gaps.min() / NANOSECONDS:.3f} s away); "
                "synchronise the sensors' clocks or raise tolerance_s"
            )
        first = int(self._pairs[0][0])
        self.camera = self._index.camera_at(int(image.stamps[first]))
        self.reference = self._index.reference_at(int(image.recorded[first]))

    def close(self) -> None:
        """Close the bag's files; garbage collection does it, too."""
        self._bag.close()

    def __enter__(self) -> BagSource:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._pairs[0])

    def __getitem__(self, index: int) -> Frame:
        image_at, cloud_at = (int(positions[index]) for positions in self._pairs)
        stamp = int(self._index.image.stamps[image_at])
        name = f"{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09d}"
        message = self._fetch(self._index.image, image_at)
        compressed = self._bag.topics[self.image_topic].type == bag_topics.COMPRESSED
        with naming(self.path, f"{self.image_topic} at {name}"):
            image = decode_compressed_image(message) if compressed else decode_image(message)
        message = self._fetch(self._index.cloud, cloud_at)
        with naming(self.path, f"{self.points_topic} at {name}"):
            cloud = decode_cloud(message)
        with naming(self.path, f"{self.image_topic} and {self.camera_info_topic} at {name}"):
            return Frame(
                image=image,
                cloud=cloud,
                camera=self._index.camera_at(stamp),
                stamp=stamp,
                cloud_stamp=int(self._index.cloud.stamps[cloud_at]),
                reference=self._index.reference_at(int(self._index.image.recorded[image_at])),
                name=name,
            )

    def _fetch(self, index: TopicIndex, position: int) -> Any:
        recorded = int(index.recorded[position])
        for topic, _, data in self._bag.raw([index.topic], recorded, recorded + 1):
            # Several messages may have been recorded at the same time.
            if peek_header(data)[0] == index.headers[position]:
                return self._bag.decode(topic, data)
        raise BadInputError(f"bag {self.path}: a message on {index.topic} is gone; the bag changed while open, open it again")

    def describe(self) -> dict[str, str]:
        """What the bag holds: label -> text."""
        pairs, images, clouds = len(self), len(self._index.image), len(self._index.cloud)
        roles = {self.image_topic: " as image", self.points_topic: " as points", self.camera_info_topic: " as camera_info"}
        return {
            "kind": "ROS 2 bag",
            "path": str(self.path),
            "storage": self._bag.storage,
            "duration": f"{self._bag.duration_s:.1f} s",
            "topics": "; ".join(
                f"{topic.name} ({topic.type.rpartition('/')[2]}, {topic.messages}){roles.get(topic.name, '')}"
                for topic in self._bag.topics.values()
            ),
            "frames": f"{pairs} pairs; without partner: {images - pairs} of {images} images, {clouds - pairs} of {clouds} clouds",
            "stamps": "of the headers" if self._index.use_headers else "of the recording (headers have none)",
            "camera": describe_camera(self.camera) + (" (rectified images)" if self.rectified else ""),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "none" if self.reference is None else "from /tf_static",
        }

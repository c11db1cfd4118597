"""A ROS 2 bag as a sequence of synchronised frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import MotionConfig
from calib_ros.datasets.bag_file import (
    COMPRESSED,
    TF,
    BagFile,
    Matrix,
    StaticTransforms,
    choose_camera_info,
    choose_image,
    choose_points,
    is_rectified,
    peek_header,
)  # fmt: skip
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.lidar.sweep import BLIND_CLOUDS, SweepOffset
from calib_ros.messages import decode_camera_info, decode_cloud, decode_compressed_image, decode_image
from calib_ros.stamps import Stamps, nearest_index, nearest_pairs, pair_tolerance, usual_period


class BagSource:
    """Frames of one camera and one LiDAR in a bag: each image with the cloud that swept its view at the nearest time, by the
    node's rules.

    Opening reads the headers of the whole bag once (at the disk's speed); `source[i]` fetches its two messages by their
    recording time. Topics are found by type if there is one of each. Not thread-safe.

    Parameters
    ----------
    tolerance_s : see online.pair_tolerance_s; 0 = from the periods of images and clouds.
    rectified : whether the images are rectified, so that CameraInfo's P is used; None: if the name of the topic says so.
    motion : how the clouds are stamped, where their points have no times.
    T_camera_lidar : where about the camera looks, (4, 4), to find when scans sweep its view; by default that of the recording's
        static transforms, else along the LiDAR's +x axis.

    `camera` and `reference` are those of the first frame. Each frame has the CameraInfo nearest in time and T_camera_lidar of
    the static transforms recorded up to then, None if they do not connect the two frames. Raises BadInputError for no or
    several candidates for a topic, no pairs, a damaged bag or message.
    """

    def __init__(
        self,
        path: str | Path,
        image_topic: str | None = None,
        points_topic: str | None = None,
        camera_info_topic: str | None = None,
        tolerance_s: float = 0.0,
        rectified: bool | None = None,
        motion: MotionConfig | None = None,
        T_camera_lidar: Matrix | None = None,
    ) -> None:
        if not 0 <= tolerance_s < 1e6:
            raise BadInputError(f"tolerance_s is {tolerance_s}, but must be 0 or more seconds")
        self.path = Path(path)
        self.name = self.path.resolve().stem if self.path.is_file() else self.path.resolve().name
        self._bag = BagFile(self.path)
        self.image_topic = choose_image(self._bag, image_topic)
        self.points_topic = choose_points(self._bag, points_topic)
        self.camera_info_topic = choose_camera_info(self._bag, camera_info_topic, self.image_topic)
        self.rectified = is_rectified(self.image_topic) if rectified is None else rectified
        self._index = BagIndex(self._bag, self.image_topic, self.points_topic, self.camera_info_topic, self.rectified)
        self.camera_frame, self.lidar_frame = self._index.camera_frame, self._index.lidar_frame
        image, cloud = self._index.image, self._index.cloud
        self._sweep_offset = self._learn_sweep(motion or MotionConfig(), T_camera_lidar)
        moments = cloud.stamps + self._sweep_offset
        periods = usual_period(np.diff(image.stamps)), usual_period(np.diff(cloud.stamps))
        tolerance = pair_tolerance(periods, tolerance_s)
        self._pairs = nearest_pairs(image.stamps, moments, tolerance)
        if not len(self):
            gaps = np.abs(moments[nearest_index(moments, image.stamps)] - image.stamps)
            raise BadInputError(
                f"bag {self.path}: no message of {self.points_topic} within {tolerance / NANOSECONDS:g} s of one of "
                f"{self.image_topic} (the nearest is {gaps.min() / NANOSECONDS:.3f} s away); "
                "synchronise the sensors' clocks or raise tolerance_s"
            )
        first = int(self._pairs[0][0])
        self.camera = self._index.camera_at(int(image.stamps[first]))
        self.reference = self._index.reference_at(int(image.recorded[first]))

    def _learn_sweep(self, motion: MotionConfig, T: Matrix | None) -> int:
        """From a cloud's stamp to the moment at which it sweeps the camera's view, ns, by the first clouds."""
        sweep, cloud = SweepOffset(motion), self._index.cloud
        for k in range(min(len(cloud), BLIND_CLOUDS)):
            if T is None:
                T = self._index.reference_at(int(cloud.recorded[k]))
            if T is None:
                T = se3.from_parts(se3.OPTICAL_FROM_BODY, np.zeros(3))
            with suppress(BadInputError):  # reported when its frame is asked for
                sweep.add(decode_cloud(self._fetch(cloud, k)), self._index.camera_at(int(cloud.stamps[k])), T)
            if sweep.ns is not None:
                return sweep.ns
        return sweep.stamped_ns

    def close(self) -> None:
        """Close the bag's files; garbage collection does it too."""
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
        compressed = self._bag.topics[self.image_topic].type == COMPRESSED
        with _located(self.path, f"{self.image_topic} at {name}"):
            image = decode_compressed_image(message) if compressed else decode_image(message)
        message = self._fetch(self._index.cloud, cloud_at)
        with _located(self.path, f"{self.points_topic} at {name}"):
            cloud = decode_cloud(message)
        with _located(self.path, f"{self.image_topic} and {self.camera_info_topic} at {name}"):
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
        raise BadInputError(f"bag {self.path}: a message on {index.topic} is gone; the bag has changed, open it again")

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
            "pairing": f"scans sweep the view {self._sweep_offset / 1e6:+.0f} ms from their stamps",
            "camera": describe_camera(self.camera) + (" (rectified images)" if self.rectified else ""),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "none" if self.reference is None else "from /tf_static",
        }


class BagIndex:
    """What is needed to pair the messages of a bag and to fetch them one by one, with its cameras and static transforms.

    Reads the whole bag once and keeps some tens of bytes per message.
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
            with _located(bag.path, topic):
                by_topic[topic].add(recorded, data)
                if topic == info_topic:
                    content = bytes(data[12:])  # all but the stamp: nearly always the same, so decoded once
                    if content not in decoded:
                        decoded[content] = decode_camera_info(bag.decode(topic, data), rectified)
                    cameras.append(decoded[content])
        for index in by_topic.values():
            if not len(index):
                raise BadInputError(f"bag {bag.path}: no message on {index.topic} is readable; copy it again or record it again")
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
        """T_camera_lidar (4, 4) as of a recording time, None if unknown; before the first transform the first one."""
        if not self._references:
            return None
        known = sum(time <= recorded for time, _ in self._references)
        return self._references[max(known - 1, 0)][1]


class TopicIndex:
    """Where the messages of one topic are.

    After `finish`, sorted by stamp, in ns: stamps (n,), headers (n,) of the headers, recorded (n,) recording times.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.frame = ""
        self._found: list[tuple[int, int]] = []  # stamp of the header, recording time

    def add(self, recorded: int, data: bytes) -> None:
        """Add a message by its header."""
        if len(data) < 16:
            raise BadInputError(f"a message has only {len(data)} bytes; record the bag again")
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
        """Sort by stamp: that of the header, or the recording time."""
        headers, recorded = np.array(self._found, np.int64).reshape(-1, 2).T
        stamps = headers if use_headers else recorded
        self.order = np.argsort(stamps, kind="stable")
        self.stamps: Stamps = stamps[self.order]
        self.headers: Stamps = headers[self.order]
        self.recorded: Stamps = recorded[self.order]


def _references(transforms: list[tuple[int, Any]], camera_frame: str, lidar_frame: str) -> list[tuple[int, Matrix]]:
    """T_camera_lidar after each static transform that changed it, with the recording time, ns."""
    tree = StaticTransforms()
    known: list[tuple[int, Matrix]] = []
    for recorded, message in transforms:
        tree.add(message)
        T = tree.lookup(camera_frame, lidar_frame)
        if T is not None and not (known and np.array_equal(T, known[-1][1])):
            known.append((recorded, T))
    return known


@contextmanager
def _located(path: Path, where: str) -> Iterator[None]:
    """Prefix BadInputError with the bag and the place of an unusable message."""
    try:
        yield
    except BadInputError as error:
        raise BadInputError(f"{path}, {where}: {error}") from error

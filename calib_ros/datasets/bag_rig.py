"""A bag with the topics of several cameras and LiDARs: reading one by a description, and writing one with its description."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.bag import BagSource, cloud_of
from calib_ros.datasets.bag_file import (
    TF,
    BagFile,
    StaticTransforms,
    choose_camera_info,
    choose_image,
    choose_points,
    is_rectified,
    peek_header,
)  # fmt: skip
from calib_ros.datasets.bag_index import RECORDING, TopicIndex
from calib_ros.datasets.bag_types import typestore
from calib_ros.datasets.bag_writer import MAX_STAMP_NS, TF_STATIC, Message, MessageBuilder, write_messages
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.rig_source import CAMERA, KEPT_CLOUDS, ByDescription, DescribedRig, RecordedRig
from calib_ros.errors import BadInputError
from calib_ros.frame import PointCloud
from calib_ros.io import write_atomically
from calib_ros.messages import decode_camera_info

DESCRIPTION = ".rig.yaml"  # beside a bag that was written
SHOWN_DIGITS = 6  # of priors: micrometres


class BagRig(ByDescription):
    """The sensors of a description in a bag, by their topics. options: of `BagSource`."""

    def __init__(self, path: Path, description: DescribedRig, **options: Any) -> None:
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
        rectified = self._options.get("rectified")
        return decode_camera_info(
            self._bag.decode(topic, self._first(topic)), is_rectified(self._topics[name]) if rectified is None else rectified
        )

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
            clock = {} if self._by_headers else {"clock": RECORDING}
            source = BagSource(self.path, *topics, **{"T_camera_lidar": view, **self._options, **clock})
            source.recent = self._recent
            self._pairs[camera, lidar] = source
        return self._pairs[camera, lidar]

    def scans(self, lidar: str) -> Timed:
        """By the clock of the pairs, differences between clocks not taken out."""
        index = self._indices[self._topics[lidar]]
        return Timed(index.stamps, lambda k: self._scan(index.topic, int(index.recorded[k]), int(index.headers[k])))

    @cached_property
    def _indices(self) -> dict[str, TopicIndex]:
        """Of all sensors' messages, by topic."""
        found = {topic: TopicIndex(topic) for topic in self._topics.values()}
        for topic, recorded, data in self._bag.heads(list(found), []):
            found[topic].add(recorded, data)
        for index in found.values():
            index.finish(self._options.get("clock") != RECORDING and all(own.has_stamps for own in found.values()))
        return found

    @property
    def _by_headers(self) -> bool:
        """Whether the headers' stamps count, which needs them of all sensors; else the times of recording."""
        return self._options.get("clock") != RECORDING and all(own.has_stamps for own in self._indices.values())

    def _scan(self, topic: str, recorded: int, header: int) -> PointCloud:
        def read() -> PointCloud:
            for _, _, data in self._bag.raw([topic], recorded, recorded + 1):
                if peek_header(data)[0] == header:
                    return cloud_of(self._bag.decode(topic, data), self._bag.topics[topic].type)
            raise BadInputError(f"bag {self.path}: a message on {topic} is gone; the bag has changed, open it again")

        return self._recent((topic, recorded, header), read)

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

    @cached_property
    def _tree(self) -> StaticTransforms:
        tree = StaticTransforms()
        statics = [t.name for t in self._bag.topics.values() if t.type == TF and t.name.endswith(TF_STATIC)]
        for topic, _, data in self._bag.raw(statics):
            tree.add(self._bag.decode(topic, data))
        return tree


def write_rig_bag(
    rig: RecordedRig, path: str | Path, storage: str = "mcap", progress: Callable[[int, int], None] | None = None
) -> tuple[Path, Path]:
    """Write all of a rig into a new bag folder, in the order of the stamps, and beside it its description; returns both paths.

    Topics are /NAME/image with /NAME/camera_info, and /NAME/points; /tf_static has what the rig states of its sensors, the
    description what somebody who mounts them believes. Raises BadInputError as `write_bag`.
    """
    path = Path(path)
    described = path.with_name(path.name + DESCRIPTION)
    if described.exists():
        raise BadInputError(f"{described} exists already and is not overwritten; remove it or give another path")
    write_messages(_messages(rig, progress), path, storage)
    text = yaml.safe_dump(description_of(rig), sort_keys=False, default_flow_style=None, width=200)
    write_atomically(described, text.encode())
    return path, described


def description_of(rig: RecordedRig) -> dict[str, Any]:
    """The description, as in rig.yaml, of the bag that a rig is written to."""
    sensors: dict[str, Any] = {}
    for name in (*rig.lidars, *rig.cameras):
        is_camera = name in rig.cameras
        own = {"kind": CAMERA, "topic": f"/{name}/image", "camera_info": f"/{name}/camera_info"} if is_camera else {}
        own = own or {"kind": "lidar", "topic": f"/{name}/points"}
        sensors[name] = own | {"frame": rig.frame_id(name)}
        if name != rig.reference_sensor:
            T = rig.prior(name)
            parts = {"translation_m": T[:3, 3], "quaternion_xyzw": se3.quaternion_from_rotation(T[:3, :3])}
            sensors[name]["prior"] = {key: [round(float(v), SHOWN_DIGITS) for v in values] for key, values in parts.items()}
    return {"reference": rig.reference_sensor, "sensors": sensors}


def _messages(rig: RecordedRig, progress: Callable[[int, int], None] | None) -> Iterator[Message]:
    types = typestore()
    build = {name: MessageBuilder(types, rig.frame_id(name), rig.frame_id(name)) for name in (*rig.cameras, *rig.lidars)}
    measured = {name: rig.pictures(name) if name in rig.cameras else rig.scans(name) for name in build}
    events = sorted((int(stamp), name, k) for name, timed in measured.items() for k, stamp in enumerate(timed.stamps))
    if not 0 <= events[0][0] <= events[-1][0] < MAX_STAMP_NS:
        raise BadInputError(f"{rig.name} has stamps which no message can hold; correct the timestamps of the source")
    # One message with all transforms: of a latched topic, late subscribers get the last one only.
    parent = MessageBuilder(types, rig.frame_id(rig.reference_sensor), "")
    stated = {name: T for name in build if name != rig.reference_sensor and (T := rig.reference(name)) is not None}
    if stated:
        yield events[0][0], TF_STATIC, parent.static_transforms(events[0][0], {rig.frame_id(n): T for n, T in stated.items()})
    cameras = {name: rig.camera(name) for name in rig.cameras}
    for done, (stamp, name, k) in enumerate(events, 1):
        value = measured[name][k][1]
        if name in cameras:
            yield stamp, f"/{name}/image", build[name].image(stamp, value)
            yield stamp, f"/{name}/camera_info", build[name].camera_info(stamp, cameras[name])
        else:
            yield stamp, f"/{name}/points", build[name].cloud(stamp, value)
        if progress is not None:
            progress(done, len(events))

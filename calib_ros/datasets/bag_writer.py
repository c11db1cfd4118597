"""Any source -> a ROS 2 bag that `ros2 bag play`, Foxglove and the node read."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.bag_types import typestore
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, PointCloud

IMAGES, CAMERA_INFO, POINTS, TF_STATIC = "/camera/image_raw", "/camera/camera_info", "/velodyne_points", "/tf_static"
MAX_STAMP_NS = 2**31 * NANOSECONDS  # what a message can hold
SPACING_NS = NANOSECONDS // 10  # between frames that have no stamps of their own
BAG_VERSION: Final = 8  # what every ROS 2 release from Humble on reads
STORAGE = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
DATATYPES = {"<f4": 7, "<u2": 4}  # of sensor_msgs/PointField, by numpy's
Message = tuple[int, str, Any]  # stamp in ns, topic, message object of rosbags
_NEVER = QosTime(9223372036, 854775807)
LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    deadline=_NEVER,
    lifespan=_NEVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_NEVER,
    avoid_ros_namespace_conventions=False,
)


def write_bag(
    source: Source,
    path: str | Path,
    storage: str = "mcap",
    positions: Sequence[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write frames of a source, by default all, into a new bag folder and return its path.

    Writes Image, CameraInfo (with the image's stamp), PointCloud2 and, if the source knows it, T_camera_lidar on /tf_static
    (again when it changes), in the order of their stamps. A frame whose stamp does not increase gets that of its predecessor
    plus 0.1 s. storage: "mcap" or "sqlite3". progress: called with (frames written, frames in all).

    Raises BadInputError if the path exists or cannot be written; then, as after an interruption, nothing is left behind.
    """
    positions = range(len(source)) if positions is None else positions
    if not len(positions):
        raise BadInputError(f"{source.name} has no frames to write; give a source with frames")
    return write_messages(_in_stamp_order(_messages(source, positions, progress)), Path(path), storage)


def write_messages(messages: Iterable[Message], path: Path, storage: str) -> Path:
    """Write messages, in the order of their stamps, into a new bag folder and return its path, as `write_bag`."""
    if storage not in STORAGE:
        raise BadInputError(f"storage '{storage}' is unknown; use one of {', '.join(STORAGE)}")
    if path.exists() or path.is_symlink():
        raise BadInputError(f"{path} exists already and is not overwritten; remove it or give another path")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # An interrupted conversion leaves no partial bag: the folder gets its name when it is complete.
        with TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch:
            partial = Path(scratch) / path.name
            with Writer(partial, version=BAG_VERSION, storage_plugin=STORAGE[storage]) as writer:
                _write(writer, messages)
            partial.rename(path)
    except OSError as error:
        raise BadInputError(
            f"bag {path} cannot be written ({error.strerror or error}); check the folder and its free space"
        ) from error
    return path


class MessageBuilder:
    """Messages of a rosbags typestore for one camera and one LiDAR. Stamps are in ns."""

    def __init__(self, typestore: Any, camera_frame: str, lidar_frame: str) -> None:
        self._types = typestore.types
        self._camera_frame = camera_frame
        self._lidar_frame = lidar_frame

    def image(self, stamp: int, image: NDArray[np.uint8]) -> Any:
        """(H, W) -> mono8, (H, W, 3) -> bgr8."""
        grey = image.ndim == 2
        return self._types["sensor_msgs/msg/Image"](
            header=self._header(stamp, self._camera_frame),
            height=image.shape[0],
            width=image.shape[1],
            encoding="mono8" if grey else "bgr8",
            is_bigendian=0,
            step=image.shape[1] * (1 if grey else 3),
            data=np.ascontiguousarray(image).reshape(-1),
        )

    def camera_info(self, stamp: int, camera: Camera) -> Any:
        """CameraInfo with K, D, R = identity, and in P the camera of the rectified image."""
        P = np.zeros((3, 4))
        P[:, :3] = camera.rectified().K
        D = camera.D if len(camera.D) else np.zeros(4 if camera.model == "equidistant" else 5)  # ROS tools expect some
        return self._types["sensor_msgs/msg/CameraInfo"](
            header=self._header(stamp, self._camera_frame),
            height=camera.height,
            width=camera.width,
            distortion_model=camera.model,
            d=D,
            k=camera.K.reshape(9),
            r=np.eye(3).reshape(9),
            p=P.reshape(12),
            binning_x=0,
            binning_y=0,
            roi=self._types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
        )

    def cloud(self, stamp: int, cloud: PointCloud) -> Any:
        """x, y, z and, if the cloud has them, intensity, ring (uint16) and time (float32, s), packed."""
        columns: dict[str, tuple[str, NDArray[Any]]] = {axis: ("<f4", cloud.xyz[:, i]) for i, axis in enumerate("xyz")}
        for name, kind in (("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")):
            values = getattr(cloud, name)
            if values is not None:
                columns[name] = (kind, values)
        points = np.empty(len(cloud), [(name, kind) for name, (kind, _) in columns.items()])
        for name, (_, values) in columns.items():
            points[name] = values
        layout: Any = points.dtype.fields
        return self._types["sensor_msgs/msg/PointCloud2"](
            header=self._header(stamp, self._lidar_frame),
            height=1,
            width=len(points),
            fields=[
                self._types["sensor_msgs/msg/PointField"](name, layout[name][1], DATATYPES[kind], 1)
                for name, (kind, _) in columns.items()
            ],
            is_bigendian=False,
            point_step=points.itemsize,
            row_step=points.nbytes,
            data=points.view(np.uint8) if len(points) else np.zeros(0, np.uint8),
            is_dense=bool(np.isfinite(cloud.xyz).all()),
        )

    def static_transform(self, stamp: int, T_camera_lidar: NDArray[np.float64]) -> Any:
        """TFMessage with the camera frame as parent of the LiDAR frame; TF maps points of the child into the parent."""
        return self.static_transforms(stamp, {self._lidar_frame: T_camera_lidar})

    def static_transforms(self, stamp: int, children: Mapping[str, NDArray[np.float64]]) -> Any:
        """TFMessage with the camera frame as parent of other frames: their poses (4, 4) in it, by name."""
        stamped = []
        for child, T in children.items():
            x, y, z = (float(v) for v in T[:3, 3])
            quaternion = (float(v) for v in se3.quaternion_from_rotation(T[:3, :3]))
            transform = self._types["geometry_msgs/msg/Transform"](
                self._types["geometry_msgs/msg/Vector3"](x, y, z), self._types["geometry_msgs/msg/Quaternion"](*quaternion)
            )
            header = self._header(stamp, self._camera_frame)
            stamped.append(self._types["geometry_msgs/msg/TransformStamped"](header, child, transform))
        return self._types["tf2_msgs/msg/TFMessage"](stamped)

    def _header(self, stamp: int, frame: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](stamp // NANOSECONDS, stamp % NANOSECONDS)
        return self._types["std_msgs/msg/Header"](time, frame)


def _write(writer: Writer, messages: Iterable[Message]) -> None:
    types = typestore()
    connections: dict[str, Connection] = {}
    for stamp, topic, content in messages:
        kind = content.__msgtype__
        if topic not in connections:
            qos = [LATCHED] if topic == TF_STATIC else []
            connections[topic] = writer.add_connection(topic, kind, typestore=types, offered_qos_profiles=qos)
        writer.write(connections[topic], stamp, types.serialize_cdr(content, kind))


def _messages(source: Source, positions: Sequence[int], progress: Callable[[int, int], None] | None) -> Iterator[list[Message]]:
    """The messages of each frame."""
    build = MessageBuilder(typestore(), source.camera_frame, source.lidar_frame)
    reference: NDArray[np.float64] | None = None
    previous: int | None = None
    for done, index in enumerate(positions, 1):
        frame = source[index]
        stamp = frame.stamp if previous is None or frame.stamp > previous else previous + SPACING_NS
        previous = stamp
        delay = 0 if frame.cloud_stamp is None else frame.cloud_stamp - frame.stamp
        cloud_stamp = max(stamp + delay, 0)
        if not 0 <= stamp < MAX_STAMP_NS or cloud_stamp >= MAX_STAMP_NS:
            raise BadInputError(
                f"frame {frame.name or index} of {source.name} is stamped {stamp / NANOSECONDS:.9g} s, its cloud "
                f"{cloud_stamp / NANOSECONDS:.9g} s, which no message can hold; correct the timestamps of the source"
            )
        messages: list[Message] = [
            (stamp, IMAGES, build.image(stamp, frame.image)),
            (stamp, CAMERA_INFO, build.camera_info(stamp, frame.camera)),
            (cloud_stamp, POINTS, build.cloud(cloud_stamp, frame.cloud)),
        ]
        if frame.reference is not None and (reference is None or not np.array_equal(reference, frame.reference)):
            reference = frame.reference
            first = min(stamp, cloud_stamp)
            messages.insert(0, (first, TF_STATIC, build.static_transform(first, reference)))
        yield messages
        if progress is not None:
            progress(done, len(positions))


def _in_stamp_order(frames: Iterable[list[Message]]) -> Iterator[Message]:
    """Messages of all frames by stamp, held back only as long as needed: a cloud may be older than its image, or newer than the
    next one."""
    waiting: list[tuple[int, int, Message]] = []
    count = 0
    for messages in frames:
        earliest = min(stamp for stamp, _, _ in messages)
        while waiting and waiting[0][0] < earliest:
            yield heapq.heappop(waiting)[2]
        for message in messages:
            heapq.heappush(waiting, (message[0], count, message))
            count += 1  # keeps equal stamps in order, and messages from being compared
    while waiting:
        yield heapq.heappop(waiting)[2]

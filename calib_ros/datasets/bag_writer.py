"""Any source or rig -> a ROS 2 bag that `ros2 bag play`, Foxglove and the node read."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.bag_file import TF_STATIC
from calib_ros.datasets.bag_messages import typestore
from calib_ros.datasets.rig import CAMERA, LIDAR, RecordedRig, RigDescription, Sensor, rig_yaml
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, PointCloud
from calib_ros.io import write_atomically

IMAGES, CAMERA_INFO, POINTS = "/camera/image_raw", "/camera/camera_info", "/velodyne_points"
MAX_STAMP_NS = 2**31 * NANOSECONDS  # what a message can hold
SPACING_NS = NANOSECONDS // 10  # between frames that have no stamps of their own
BAG_VERSION: Final = 8  # what every ROS 2 release from Humble on reads
STORAGE = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
DATATYPES = {"<f4": 7, "<u2": 4}  # of sensor_msgs/PointField, by numpy's
DESCRIPTION = ".rig.yaml"  # beside the bag of a rig
Progress = Callable[[int, int], None]  # called with how much is written, and how much there is
Message = tuple[int, str, Any]  # stamp in ns, topic, message object of rosbags
_FOREVER = QosTime(9223372036, 854775807)
_KEPT = (QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL)
LATCHED = Qos(*_KEPT, _FOREVER, _FOREVER, QosLiveliness.AUTOMATIC, _FOREVER, False)


def write_bag(
    source: Source,
    path: str | Path,
    storage: str = "mcap",
    positions: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write frames of a source, by default all, into a new bag folder and return its path.

    Writes Image, CameraInfo (with the image's stamp), PointCloud2 and, if the source knows it, T_camera_lidar on /tf_static
    (again when it changes), in the order of their stamps. A frame whose stamp does not increase gets that of its predecessor
    plus 0.1 s. storage: "mcap" or "sqlite3".

    Raises BadInputError if the path exists or cannot be written; then, as after an interruption, nothing is left behind.
    """
    positions = range(len(source)) if positions is None else positions
    if not len(positions):
        raise BadInputError(f"{source.name} has no frames to write; give a source with frames")
    return _write(_in_stamp_order(_of_frames(source, positions, progress)), Path(path), storage)


def write_rig_bag(
    rig: RecordedRig, path: str | Path, storage: str = "mcap", progress: Progress | None = None
) -> tuple[Path, Path]:
    """Write all of a rig into a new bag folder, in the order of the stamps, and beside it its description; returns both paths.

    Topics are /NAME/image with /NAME/camera_info, and /NAME/points; /tf_static has what the rig states of its sensors, the
    description what somebody who mounts them believes. Raises BadInputError as `write_bag`.
    """
    path = Path(path)
    described = path.with_name(path.name + DESCRIPTION)
    if described.exists():
        raise BadInputError(f"{described} exists already and is not overwritten; remove it or give another path")
    _write(_of_rig(rig, progress), path, storage)
    sensors = []
    for name in (*rig.lidars, *rig.cameras):
        of_camera = CAMERA, f"/{name}/image", f"/{name}/camera_info"
        kind, topic, info = of_camera if name in rig.cameras else (LIDAR, f"/{name}/points", "")
        sensors.append(Sensor(name, kind, topic, info, rig.frame_id(name), rig.prior(name)))
    text = rig_yaml(RigDescription(tuple(sensors), rig.reference_sensor))
    write_atomically(described, text.encode())
    return path, described


def _write(messages: Iterable[Message], path: Path, storage: str) -> Path:
    """Write messages, in the order of their stamps, into a new bag folder and return its path."""
    if storage not in STORAGE:
        raise BadInputError(f"storage '{storage}' is unknown; use one of {', '.join(STORAGE)}")
    if path.exists() or path.is_symlink():
        raise BadInputError(f"{path} exists already and is not overwritten; remove it or give another path")
    types = typestore()
    connections: dict[str, Connection] = {}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # An interrupted conversion leaves no partial bag: the folder gets its name when it is complete.
        with TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch:
            partial = Path(scratch) / path.name
            with Writer(partial, version=BAG_VERSION, storage_plugin=STORAGE[storage]) as writer:
                for stamp, topic, content in messages:
                    kind = content.__msgtype__
                    if topic not in connections:
                        qos = [LATCHED] if topic == TF_STATIC else []
                        connections[topic] = writer.add_connection(topic, kind, typestore=types, offered_qos_profiles=qos)
                    writer.write(connections[topic], stamp, types.serialize_cdr(content, kind))
            partial.rename(path)
    except OSError as error:
        raise BadInputError(
            f"bag {path} cannot be written ({error.strerror or error}); check the folder and its free space"
        ) from error
    return path


def _of_frames(source: Source, positions: Sequence[int], progress: Progress | None) -> Iterator[list[Message]]:
    """The messages of each frame."""
    camera, lidar = source.camera_frame, source.lidar_frame
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
            (stamp, IMAGES, image_message(stamp, camera, frame.image)),
            (stamp, CAMERA_INFO, camera_info_message(stamp, camera, frame.camera)),
            (cloud_stamp, POINTS, cloud_message(cloud_stamp, lidar, frame.cloud)),
        ]
        if frame.reference is not None and (reference is None or not np.array_equal(reference, frame.reference)):
            reference = frame.reference
            first = min(stamp, cloud_stamp)
            messages.insert(0, (first, TF_STATIC, transforms_message(first, camera, {lidar: reference})))
        yield messages
        if progress is not None:
            progress(done, len(positions))


def _in_stamp_order(frames: Iterable[list[Message]]) -> Iterator[Message]:
    """Messages of all frames by stamp, held back only as long as needed: a cloud may be older than its image, or newer than the
    next one."""
    waiting: list[Message] = []
    for messages in frames:
        earliest = min(stamp for stamp, _, _ in messages)
        ready = bisect_left(waiting, earliest, key=itemgetter(0))
        yield from waiting[:ready]
        waiting = sorted([*waiting[ready:], *messages], key=itemgetter(0))
    yield from waiting


def _of_rig(rig: RecordedRig, progress: Progress | None) -> Iterator[Message]:
    frames = {name: rig.frame_id(name) for name in (*rig.cameras, *rig.lidars)}
    measured = {name: rig.pictures(name) if name in rig.cameras else rig.scans(name) for name in frames}
    events = sorted((int(stamp), name, k) for name, timed in measured.items() for k, stamp in enumerate(timed.stamps))
    if not 0 <= events[0][0] <= events[-1][0] < MAX_STAMP_NS:
        raise BadInputError(f"{rig.name} has stamps which no message can hold; correct the timestamps of the source")
    # One message with all transforms: of a latched topic, late subscribers get the last one only.
    reference, begin = rig.reference_sensor, events[0][0]
    stated = {frames[name]: T for name in frames if name != reference and (T := rig.reference(name)) is not None}
    if stated:
        yield begin, TF_STATIC, transforms_message(begin, rig.frame_id(reference), stated)
    cameras = {name: rig.camera(name) for name in rig.cameras}
    for done, (stamp, name, k) in enumerate(events, 1):
        value = measured[name][k][1]
        if name in cameras:
            yield stamp, f"/{name}/image", image_message(stamp, frames[name], value)
            yield stamp, f"/{name}/camera_info", camera_info_message(stamp, frames[name], cameras[name])
        else:
            yield stamp, f"/{name}/points", cloud_message(stamp, frames[name], value)
        if progress is not None:
            progress(done, len(events))


def image_message(stamp: int, frame: str, image: NDArray[np.uint8]) -> Any:
    """(H, W) -> mono8, (H, W, 3) -> bgr8. stamp: ns. frame: of TF."""
    height, width, channels = (*image.shape, 1)[:3]
    data = np.ascontiguousarray(image).reshape(-1)
    encoding = "mono8" if image.ndim == 2 else "bgr8"
    return _message("sensor_msgs/msg/Image", _header(stamp, frame), height, width, encoding, 0, width * channels, data)


def camera_info_message(stamp: int, frame: str, camera: Camera) -> Any:
    """CameraInfo with K, D, R = identity, and in P the camera of the rectified image. stamp: ns."""
    P = np.zeros((3, 4))
    P[:, :3] = camera.rectified().K
    D = camera.D if len(camera.D) else np.zeros(4 if camera.model == "equidistant" else 5)  # ROS tools expect some
    matrices = D, camera.K.reshape(9), np.eye(3).reshape(9), P.reshape(12)
    binning, roi = (0, 0), _message("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    size = camera.height, camera.width
    return _message("sensor_msgs/msg/CameraInfo", _header(stamp, frame), *size, camera.model, *matrices, *binning, roi)


def cloud_message(stamp: int, frame: str, cloud: PointCloud) -> Any:
    """x, y, z and, if the cloud has them, intensity, ring (uint16) and time (float32, s), packed. stamp: ns."""
    columns: dict[str, tuple[str, NDArray[Any]]] = {axis: ("<f4", cloud.xyz[:, i]) for i, axis in enumerate("xyz")}
    optional = {"intensity": ("<f4", cloud.intensity), "ring": ("<u2", cloud.ring), "time": ("<f4", cloud.time)}
    columns |= {name: (kind, values) for name, (kind, values) in optional.items() if values is not None}
    points = np.empty(len(cloud), [(name, kind) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        points[name] = values
    layout: Any = points.dtype.fields
    fields = [
        _message("sensor_msgs/msg/PointField", name, layout[name][1], DATATYPES[kind], 1) for name, (kind, _) in columns.items()
    ]
    data = points.view(np.uint8) if len(points) else np.zeros(0, np.uint8)
    steps, dense = (points.itemsize, points.nbytes), bool(np.isfinite(cloud.xyz).all())
    return _message("sensor_msgs/msg/PointCloud2", _header(stamp, frame), 1, len(points), fields, False, *steps, data, dense)


def transforms_message(stamp: int, parent: str, children: Mapping[str, NDArray[np.float64]]) -> Any:
    """TFMessage with a frame as parent of others: their poses (4, 4) in it, by name; TF maps points of the child into the parent.
    stamp: ns."""
    stamped = []
    for child, T in children.items():
        translation = _message("geometry_msgs/msg/Vector3", *map(float, T[:3, 3]))
        rotation = _message("geometry_msgs/msg/Quaternion", *map(float, se3.quaternion_from_rotation(T[:3, :3])))
        transform = _message("geometry_msgs/msg/Transform", translation, rotation)
        stamped.append(_message("geometry_msgs/msg/TransformStamped", _header(stamp, parent), child, transform))
    return _message("tf2_msgs/msg/TFMessage", stamped)


def _header(stamp: int, frame: str) -> Any:
    return _message("std_msgs/msg/Header", _message("builtin_interfaces/msg/Time", *divmod(stamp, NANOSECONDS)), frame)


def _message(kind: str, *values: Any, **named: Any) -> Any:
    return typestore().types[kind](*values, **named)

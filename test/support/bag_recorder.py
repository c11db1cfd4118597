"""Bags as tests record them: frames, and any messages with any times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from ros_messages import TYPES, Messages
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from calib_ros.camera import Camera
from calib_ros.frame import Frame, PointCloud
from calib_ros.se3 import exp, quaternion_from_rotation

MS = 1_000_000
STORAGES = ["mcap", "sqlite3"]
START = 1_700_000_000_000_000_000
K = np.array([[30.0, 0, 20], [0, 31, 12], [0, 0, 1]])
PINHOLE = Camera(K, 40, 24)
DISTORTED = Camera(K, 40, 24, "plumb_bob", np.array([-0.2, 0.05, 0.001, -0.001, 0.0]))
A, B, C = exp([0.1, 0, 0, 1, 0, 0]), exp([0, 0.5, 0, 0, 2, 0]), exp([0, 0, -2, 0, 0, 3])
T_CAMERA_LIDAR = exp([0.3, -1.2, 0.7, 0.1, -0.2, 0.3])


def frame(i: int, grey: bool = False, camera: Camera = PINHOLE, points: int = 60, **changes) -> Frame:
    rng = np.random.default_rng(i)
    xyz = rng.normal(size=(points, 3)).astype(np.float32)
    xyz[:1] = np.nan
    cloud = PointCloud(
        xyz,
        rng.random(points).astype(np.float32),
        rng.integers(0, 128, points).astype(np.int32),
        np.linspace(-0.05, 0.05, points).astype(np.float32),
    )
    made = Frame(
        image=rng.integers(0, 256, (24, 40) if grey else (24, 40, 3), np.uint8),
        cloud=cloud,
        camera=camera,
        stamp=START + i * 100_000_003,
        cloud_stamp=START + i * 100_000_003 - 10_000_000,
        reference=T_CAMERA_LIDAR,
    )
    return replace(made, **changes)


def as_ros1(bag: Path, path: Path) -> None:
    """A bag of ROS 2 as one of ROS 1."""
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    with Reader(bag) as reader, Ros1Writer(path) as writer:
        topics = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        for connection, time, data in reader.messages():
            writer.write(topics[connection.topic], time, TYPES.cdr_to_ros1(data, connection.msgtype))


def assert_same(a: Frame, b: Frame) -> None:
    assert np.array_equal(a.image, b.image)
    for name in ("xyz", "intensity", "ring", "time"):
        one, other = getattr(a.cloud, name), getattr(b.cloud, name)
        assert (one is None) == (other is None), name
        assert one is None or (np.array_equal(one, other, equal_nan=True) and one.dtype == other.dtype), name
    assert a.camera == b.camera
    assert (a.stamp, a.cloud_stamp) == (b.stamp, b.cloud_stamp)
    assert (a.reference is None) == (b.reference is None)
    assert a.reference is None or np.abs(a.reference - b.reference).max() < 1e-12


class Recorder:
    """Writes any messages as a recorder would: with times of recording, compression, several publishers."""

    def __init__(self, path: Path, storage: str = "mcap", compression: CompressionMode = CompressionMode.NONE) -> None:
        self.writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
        if compression != CompressionMode.NONE:
            self.writer.set_compression(compression, CompressionFormat.ZSTD)
        self.ros = Messages("rosbags")
        self.connections = {}

    def __enter__(self) -> Recorder:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def write(self, topic: str, message, time: int) -> None:
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=TYPES)
        self.writer.write(self.connections[topic], time, TYPES.serialize_cdr(message, kind))

    def image(self, stamp: int, topic: str = "/cam/image_raw", time: int | None = None, value: int = 0, frame="cam") -> None:
        message = self.ros.image("mono8", 8, 6, np.full(48, value, np.uint8), 8)
        message.header = self.ros.header(stamp, frame)
        self.write(topic, message, stamp if time is None else time)

    def compressed(self, stamp: int, topic: str, layout: str = "mono8; png compressed") -> None:
        message = self.ros.compressed(layout, cv2.imencode(".png", np.full((6, 8), 9, np.uint8))[1].tobytes())
        message.header = self.ros.header(stamp, "cam")
        self.write(topic, message, stamp)

    def info(
        self,
        stamp: int,
        topic: str = "/cam/camera_info",
        fx: float = 5.0,
        time: int | None = None,
        size: tuple[int, int] = (8, 6),
    ) -> None:
        matrix = np.array([[fx, 0, 4], [0, fx, 3], [0, 0, 1]])
        message = self.ros.camera_info(*size, matrix, [0.1, 0, 0, 0, 0], np.c_[matrix * [[2], [2], [1]], np.zeros(3)])
        message.header = self.ros.header(stamp, "cam")
        self.write(topic, message, stamp if time is None else time)

    def cloud(self, stamp: int, topic: str = "/points", time: int | None = None, value: float = 1, frame: str = "lidar") -> None:
        points = np.full(3, value, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
        message = self.ros.cloud(points)
        message.header = self.ros.header(stamp, frame)
        self.write(topic, message, stamp if time is None else time)

    def static(self, time: int, *edges: tuple[str, str, np.ndarray], topic: str = "/tf_static", scale: float = 1.0) -> None:
        make, transforms = self.ros.make, []
        for parent, child, T in edges:
            q = dict(zip("xyzw", (float(v) * scale for v in quaternion_from_rotation(T[:3, :3])), strict=True))
            t = dict(zip("xyz", T[:3, 3].tolist(), strict=True))
            translation, rotation = make("geometry_msgs/msg/Vector3", **t), make("geometry_msgs/msg/Quaternion", **q)
            transform = make("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
            names = {"header": self.ros.header(time, parent), "child_frame_id": child}
            transforms.append(make("geometry_msgs/msg/TransformStamped", **names, transform=transform))
        self.write(topic, make("tf2_msgs/msg/TFMessage", transforms=transforms), time)

    def trio(
        self,
        stamp: int,
        value: int = 0,
        time: int | None = None,
        cloud: int | None = None,
        cloud_time: int | None = None,
        **of_image,
    ) -> None:
        """An image with its CameraInfo, recorded at `time`, and a cloud stamped `cloud` and recorded at `cloud_time`."""
        self.image(stamp, time=time, value=value, **of_image)
        self.info(stamp, time=time)
        self.cloud(stamp if cloud is None else cloud, time=cloud_time, value=value)


def recorded(
    path: Path, write: Callable[[Recorder, int, int], object] = Recorder.trio, count: int = 1, storage: str = "mcap", **options
) -> Path:
    """A bag for which `write` is called with times 0.1 s apart and their numbers."""
    with Recorder(path, storage, **options) as recorder:
        for i in range(count):
            write(recorder, START + 100 * MS * i, i)
    return path

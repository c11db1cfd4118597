"""Any source -> a ROS 2 bag that `ros2 bag play`, Foxglove and this package's node read."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer

from calib_ros.datasets.bag import MessageBuilder, typestore
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS

TF_STATIC = "/tf_static"
MAX_STAMP_NS = 2**31 * NANOSECONDS  # what a message can hold
SPACING_NS = NANOSECONDS // 10  # between frames that have no stamps of their own
BAG_VERSION: Final = 8  # what every ROS 2 release from Humble on reads
STORAGE = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
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


class Message(NamedTuple):
    """A message on its way into the bag: its stamp in ns, its topic and rosbags' object."""

    stamp: int
    topic: str
    content: Any


class Topics(NamedTuple):
    """The topics of the bag."""

    image: str
    camera_info: str
    points: str


def write_bag(
    source: Source,
    path: str | Path,
    storage: str = "mcap",
    *,
    image_topic: str = "/camera/image_raw",
    camera_info_topic: str = "/camera/camera_info",
    points_topic: str = "/velodyne_points",
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write all frames of a source into a new bag folder and return its path.

    Image, CameraInfo (with the image's stamp), PointCloud2 and, where the source knows it, T_camera_lidar
    on /tf_static (again when it changes), in the order of their stamps. A frame whose stamp does not
    increase follows its predecessor after 0.1 s. storage: "mcap" or "sqlite3". progress: called with
    (frames written, frames in all). BadInputError when the path exists or cannot be written; then, as after
    an interruption, nothing is left behind.
    """
    path = Path(path)
    topics = Topics(image_topic, camera_info_topic, points_topic)
    if storage not in STORAGE:
        raise BadInputError(f"storage '{storage}' is unknown; use one of {', '.join(STORAGE)}")
    if path.exists() or path.is_symlink():
        raise BadInputError(f"{path} exists already and is not overwritten; remove it or give another path")
    if not len(source):
        raise BadInputError(f"{source.name} has no frames to write; give a source with frames")
    if len({*topics, TF_STATIC}) < 4:
        raise BadInputError(f"topics {', '.join(topics)} must differ from each other and from {TF_STATIC}; rename one")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # An interrupted conversion must leave no half bag: the folder gets its name when it is complete.
        with TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch:
            partial = Path(scratch) / path.name
            with Writer(partial, version=BAG_VERSION, storage_plugin=STORAGE[storage]) as writer:
                _write(writer, _in_stamp_order(_messages(source, topics, progress)))
            partial.rename(path)
    except OSError as error:
        raise BadInputError(
            f"bag {path} cannot be written ({error.strerror or error}); check the folder and its free space"
        ) from error
    return path


def _write(writer: Writer, messages: Iterable[Message]) -> None:
    types = typestore()
    connections: dict[str, Connection] = {}
    for stamp, topic, content in messages:
        kind = content.__msgtype__
        if topic not in connections:
            qos = [LATCHED] if topic == TF_STATIC else []
            connections[topic] = writer.add_connection(topic, kind, typestore=types, offered_qos_profiles=qos)
        writer.write(connections[topic], stamp, types.serialize_cdr(content, kind))


def _messages(source: Source, topics: Topics, progress: Callable[[int, int], None] | None) -> Iterator[list[Message]]:
    """The messages of one frame after the other."""
    build = MessageBuilder(typestore(), source.camera_frame, source.lidar_frame)
    reference: NDArray[np.float64] | None = None
    previous: int | None = None
    for index in range(len(source)):
        frame = source[index]
        stamp = frame.stamp
        if previous is not None and stamp <= previous:
            stamp = previous + SPACING_NS
        previous = stamp
        delay = 0 if frame.cloud_stamp is None else frame.cloud_stamp - frame.stamp
        cloud_stamp = max(stamp + delay, 0)
        if not 0 <= stamp < MAX_STAMP_NS or cloud_stamp >= MAX_STAMP_NS:
            raise BadInputError(
                f"frame {frame.name or index} of {source.name} is stamped {stamp / NANOSECONDS:.9g} s, its cloud "
                f"{cloud_stamp / NANOSECONDS:.9g} s, which no message can hold; correct the timestamps of the source"
            )
        messages = [
            Message(stamp, topics.image, build.image(stamp, frame.image)),
            Message(stamp, topics.camera_info, build.camera_info(stamp, frame.camera)),
            Message(cloud_stamp, topics.points, build.cloud(cloud_stamp, frame.cloud)),
        ]
        if frame.reference is not None and (reference is None or not np.array_equal(reference, frame.reference)):
            reference = frame.reference
            first = min(stamp, cloud_stamp)
            messages.insert(0, Message(first, TF_STATIC, build.static_transform(first, reference)))
        yield messages
        if progress is not None:
            progress(index + 1, len(source))


def _in_stamp_order(frames: Iterable[list[Message]]) -> Iterator[Message]:
    """Messages of all frames by stamp, with only as many held back as needed.

    A cloud may be older than its image or younger than the next one.
    """
    waiting: list[tuple[int, int, Message]] = []
    count = 0
    for messages in frames:
        earliest = min(message.stamp for message in messages)
        while waiting and waiting[0][0] < earliest:
            yield heapq.heappop(waiting)[2]
        for message in messages:
            heapq.heappush(waiting, (message.stamp, count, message))
            count += 1  # keeps the order of equal stamps, and messages from being compared
    while waiting:
        yield heapq.heappop(waiting)[2]

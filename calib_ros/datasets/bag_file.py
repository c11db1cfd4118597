"""A bag on disk, read through rosbags: topics, raw messages, static transforms, clear errors."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from weakref import finalize

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.datasets.bag_parts import METADATA, BagParts, storage_files, storage_of
from calib_ros.datasets.bag_types import layout_of, typestore
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import NANOSECONDS
from calib_ros.messages.compressed_points import COMPRESSED_POINTS, REPUBLISH
from calib_ros.messages.point_fields import LIVOX, decode_livox
from calib_ros.messages.video import VIDEO
from calib_ros.messages.wire import shown, wire_header

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINTS = "sensor_msgs/msg/PointCloud2"
TF = "tf2_msgs/msg/TFMessage"
# Types that hold images or clouds in a form that is not read, and what makes one that is.
REMEDIES = {
    "VelodyneScan": "play the bag, run the transform node of velodyne_pointcloud for your model, and record its cloud",
    "PacketMsg": "play the bag, run the cloud node of ouster_ros, and record its cloud",
    "CompressedPointCloud2": REPUBLISH,  # of other packages
    "LaserScan": "a scan of one plane has no edges to calibrate by; record a 3-D LiDAR",
}
MOST_NAMED = 40  # topics that an error names
DEPTH = "/compressedDepth"  # how image_transport names the topics of depth images
YAML_MERGE, YAML_ALIAS, MAX_ALIASES = re.compile(rb"<<\s*:"), re.compile(rb"[\s\[{,:]\*\w"), 10  # no recorder writes either


class Topic(NamedTuple):
    """A topic of a bag: message type, like "sensor_msgs/msg/Image", and number of messages."""

    name: str
    type: str
    messages: int


class BagFile:
    """An open bag: topics, raw messages, decoding. Not thread-safe. Closes its files on `close` or garbage collection.

    indexed: whether messages of a topic and time are found without reading the others, as in an mcap file with chunks and a
    summary. Raises BadInputError for whatever is wrong with its files, when opening or when reading.
    """

    def __init__(self, path: Path, incomplete: bool = False) -> None:
        self.path = path
        self.storage = storage_of(_some_file(path))
        tool = {"mcap": "recover it with `mcap recover`, ", "ROS 1": "mend it with `rosbag reindex`, "}.get(self.storage, "")
        self._advice = f"{tool}copy it again or record it again"
        self._types = typestore()
        with self._readable():
            _check_metadata(path / METADATA)
            self._parts = BagParts(path, incomplete)
        self.close = finalize(self, self._parts.close)
        self.remarks = tuple(self._parts.remarks)
        with self._readable():
            self.topics = _topics(self._parts.connections)
            self._layouts = {connection.topic: layout_of(connection) for connection in self._parts.connections}
            self.start, self.stop = self._parts.start, self._parts.stop  # recording times, ns
            self.duration_s = (self.stop - self.start) / NANOSECONDS
            self.indexed = self._parts.indexed

    @property
    def size(self) -> int:
        """Of its files, bytes."""
        files = [self.path] if self.path.is_file() else [file for file in self.path.iterdir() if file.is_file()]
        return sum(file.stat().st_size for file in files)

    def period(self, topic: str) -> int:
        """Mean time between the messages of a topic, ns; the length of the bag where there are none."""
        return round((self.stop - self.start) / max(self.topics[topic].messages, 1))

    def raw(self, topics: Collection[str], start: int | None = None, stop: int | None = None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, time of recording in ns, CDR bytes) of messages recorded in [start, stop), in order."""
        with self._readable():
            yield from self._parts.messages(topics, start, stop)

    def heads(self, topics: Collection[str], whole: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """As `raw` of all, about in order, and of topics that are not in `whole` maybe no more than the header."""
        with self._readable():
            yield from self._parts.heads(topics, whole)

    def decode(self, topic: str, data: bytes) -> Any:
        """CDR bytes -> message of the topic's type, of Livox's own type its PointCloud."""
        kind = self.topics[topic].type
        if kind in LIVOX:
            return decode_livox(data)
        with self._readable(f"{topic}: "):
            return self._types.deserialize_cdr(data, self._layouts[topic])

    @contextmanager
    def _readable(self, where: str = "") -> Iterator[None]:
        # A damaged file raises whatever the damaged place leads to: struct, zstd, sqlite, assertion, memory, key errors.
        try:
            yield
        except CalibrationError:
            raise
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise BadInputError(f"{where}bag {self.path} cannot be read ({reason}); {self._advice}") from error


def _some_file(path: Path) -> Path:
    """A file of a bag, whose ending is its format."""
    if not path.exists():
        raise BadInputError(f"{path} does not exist; give a bag folder, a .mcap, .db3 or .bag file")
    files = [path] if path.is_file() else storage_files(path)
    if not files:
        raise BadInputError(f"bag {path} has no .mcap, .db3 or .bag file; copy the whole folder")
    if not storage_of(files[0]):
        raise BadInputError(f"{path} is no bag; give a bag folder, a .mcap, .db3 or .bag file")
    return files[0]


def peek_header(data: bytes) -> tuple[int, str]:
    """Stamp in ns and frame id of a CDR message that begins with a std_msgs/Header; the rest is not decoded."""
    header = wire_header(data)
    # Some drivers keep the leading slash of tf1, which tf2 forbids.
    return header.stamp, header.frame_id.lstrip("/")


class StaticTransforms:
    """The tree of /tf_static. As in tf2, the latest transform of a child counts and broken ones are ignored."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Matrix]] = {}  # child -> parent, T_parent_child

    def add(self, msg: Any) -> None:
        """Add all transforms of a TFMessage."""
        for item in msg.transforms:
            t, q = item.transform.translation, item.transform.rotation
            try:
                rotation = se3.rotation_from_quaternion([q.x, q.y, q.z, q.w])
            except BadInputError:
                continue
            translation = np.array([t.x, t.y, t.z], float)
            if np.isfinite(translation).all():
                parent, child = item.header.frame_id.lstrip("/"), item.child_frame_id.lstrip("/")
                self._parents[child] = (parent, se3.from_parts(rotation, translation))

    def parent(self, child: str) -> str | None:
        """The parent of a frame; None if it has none, or is unknown."""
        edge = self._parents.get(child)
        return None if edge is None else edge[0]

    def lookup(self, target: str, source: str, without: str | None = None) -> Matrix | None:
        """T_target_source (4, 4) through the tree in either direction; None if the frames are not connected. without: a child
        whose edge to its parent is left out."""
        found = self._reached(target, without)
        return found[source][0] if source in found else None

    def frames(self, target: str) -> dict[str, Matrix]:
        """T_target_frame (4, 4) of all frames that are connected to `target`, by name."""
        return {frame: T for frame, (T, _) in self._reached(target).items()}

    def path(self, target: str, source: str) -> list[tuple[str, str]]:
        """The edges (parent, child) between two frames, from the target on; none if they are not connected."""
        found, edges = self._reached(target), []
        while source in found and source != target:
            before = found[source][1]
            edges.append((before, source) if self.parent(source) == before else (source, before))
            source = before
        return edges[::-1]

    def _reached(self, target: str, without: str | None = None) -> dict[str, tuple[Matrix, str]]:
        """Every frame that the tree connects to `target`, with T_target_frame (4, 4) and the frame before it."""
        edges: dict[str, list[tuple[str, Matrix]]] = {}
        for child, (parent, T_parent_child) in list(self._parents.items()):  # another thread may add
            if child != without:
                edges.setdefault(parent, []).append((child, T_parent_child))
                edges.setdefault(child, []).append((parent, se3.inverse(T_parent_child)))
        if target not in edges:
            return {}
        found = {target: (np.eye(4), target)}
        queue = deque([target])
        while queue:
            frame = queue.popleft()
            for neighbour, T_frame_neighbour in edges[frame]:
                if neighbour not in found:
                    found[neighbour] = (found[frame][0] @ T_frame_neighbour, frame)
                    queue.append(neighbour)
        return found


def choose_image(bag: BagFile, requested: str | None, option: str = "--image-topic") -> str:
    """The image topic: the requested one, or the only one. A raw image wins over its compressed transport. option: what to set,
    if it is not there."""
    candidates = _with_type(bag, IMAGE, COMPRESSED)
    if requested is None:
        candidates = [name for name in candidates if not name.endswith(DEPTH)]
        transports = {f"{name}/compressed" for name in candidates}
        candidates = [name for name in candidates if name not in transports]
    if requested is not None or not candidates:
        candidates += _with_type(bag, *VIDEO)
    return _choose(bag, requested, candidates, "Image, CompressedImage or video", option)


def choose_points(bag: BagFile, requested: str | None, option: str = "--points-topic") -> str:
    """The cloud topic: the requested one, or the only one. option: what to set, if it is not there."""
    candidates = _with_type(bag, POINTS)
    if requested is not None or not candidates:
        candidates += _with_type(bag, *LIVOX, COMPRESSED_POINTS)
    return _choose(bag, requested, candidates, "PointCloud2", option)


def choose_camera_info(bag: BagFile, requested: str | None, image_topic: str, option: str = "--camera-info-topic") -> str:
    """The requested CameraInfo topic, or the one beside the image (image_transport's rule), or the only one. option: what to set,
    if it is not there."""
    candidates = _with_type(bag, CAMERA_INFO)
    beside = re.sub(r"/(compressed|ffmpeg|foxglove)$", "", image_topic).rpartition("/")[0] + "/camera_info"
    if requested is None and beside in candidates:
        return beside
    return _choose(bag, requested, candidates, "CameraInfo", option)


def is_rectified(image_topic: str) -> bool:
    """Whether the name of a topic says rectified, as image_proc names them (image_rect, image_rect_color)."""
    return re.search(r"(^|[/_])rect(ified)?($|[/_])", image_topic) is not None


def _choose(bag: BagFile, requested: str | None, candidates: list[str], kind: str, option: str) -> str:
    if requested is not None:
        name = "/" + requested.strip("/")
        for own in (name, name[1:]):  # topics of ROS 1 may have no slash
            if own in candidates:
                return own
        has = f"it has {_named(candidates)}" if candidates else "it has none"
        raise BadInputError(f"bag {bag.path} has no {kind} messages on topic {name}; {has}; set {option} accordingly")
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise BadInputError(
            f"bag {bag.path} has {len(candidates)} topics of type {kind}: {_named(candidates)}; choose one with {option}"
        )
    others = _named([f"{topic.name} ({topic.type})" for topic in bag.topics.values()]) or "nothing at all"
    names = dict.fromkeys(topic.type.rpartition("/")[2] for topic in bag.topics.values() if topic.messages)
    depth = [f"{shown(topic)} is a depth image, no camera picture" for topic in bag.topics if topic.endswith(DEPTH)]
    known = [f"{name}: {REMEDIES[name]}" for name in names if name in REMEDIES]
    advice = "; ".join([*(depth if kind.startswith("Image") else []), *known]) or "record that topic too"
    raise BadInputError(f"bag {bag.path} has no {kind} messages, only {others}; {advice}")


def _named(topics: list[str]) -> str:
    return ", ".join([*(" ".join(topic.split()) for topic in topics[:MOST_NAMED]), *["..."] * (len(topics) > MOST_NAMED)])


def _with_type(bag: BagFile, *types: str) -> list[str]:
    return [topic.name for topic in bag.topics.values() if topic.type in types and topic.messages > 0]


def _check_metadata(path: Path) -> None:
    """ValueError for a file with YAML aliases or merges: a few lines of them expand to millions, over which rosbags hangs."""
    text = path.read_bytes() if path.is_file() else b""
    if YAML_MERGE.search(text) or len(YAML_ALIAS.findall(text)) > MAX_ALIASES:
        raise ValueError("metadata.yaml refers to parts of itself")


def _topics(connections: Collection[Any]) -> dict[str, Topic]:
    """Topics by name. TypeError where metadata.yaml, which rosbags does not check, has no text or no number."""
    counts: dict[str, int] = {}
    for connection in connections:  # one topic may have several connections, one per publisher's QoS
        if not isinstance(connection.topic, str) or not isinstance(connection.msgtype, str):
            raise TypeError("a topic without a name or a type")
        if not isinstance(connection.msgcount, int):
            raise TypeError(f"{connection.topic} has no number of messages")
        counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    types = {connection.topic: connection.msgtype for connection in connections}
    return {name: Topic(name, types[name], count) for name, count in sorted(counts.items())}

"""A ROS 2 bag as a sequence of synchronised frames."""

from __future__ import annotations

import re
import struct
from collections import deque
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from weakref import finalize

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.datasets.source import Stamps, describe_camera, nearest_index, nearest_pairs
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.messages import decode_camera_info, decode_cloud, decode_compressed_image, decode_image

# A ROS 2 bag on disk, mcap or sqlite3, read through rosbags: topics, raw messages, clear errors.
# What lets a few lines of YAML stand for millions, over which its reader would hang. No recorder writes either.
MERGED, ALIAS, FEW_ALIASES = re.compile(rb"<<\s*:"), re.compile(rb"[\s\[{,:]\*\w"), 10
STORAGE = {".mcap": "mcap", ".db3": "sqlite3"}


@cache
def typestore() -> Typestore:
    """The message types of ROS 2.

    Those used here have been the same in every release. So the definitions embedded in a bag, which also
    hold the user's own types in unknown states, are not needed.
    """
    return get_typestore(Stores.ROS2_KILTED)


class Topic(NamedTuple):
    """A topic of a bag: its message type, like "sensor_msgs/msg/Image", and how many messages it has."""

    name: str
    type: str
    messages: int


class BagFile:
    """An open bag.

    BadInputError, with what to do, for whatever is wrong with its files, when opening or when reading.
    Not for several threads at once. Closes its files when it is closed or forgotten.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        store = storage_file(path)
        self.storage = STORAGE[store.suffix]
        self._advice = (
            "recover it with `mcap recover`, copy it again or record it anew"
            if self.storage == "mcap"
            else "copy it again or record it anew; if only metadata.yaml is damaged, run `ros2 bag reindex`"
        )
        self._types = typestore()
        with self._readable():
            _check_metadata(path / "metadata.yaml")
            self._reader = Reader(path if (path / "metadata.yaml").exists() else store)
            self._reader.open()
        self.close = finalize(self, self._reader.close)
        with self._readable():
            self.topics = _topics(self._reader.connections)
            self.duration_s = self._reader.duration / NANOSECONDS

    def raw(self, topics: Collection[str], start: int | None = None, stop: int | None = None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, time of recording in ns, CDR bytes) of messages recorded in [start, stop), in order."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:  # rosbags takes an empty list for "all"
            return
        with self._readable():
            for connection, time, data in self._reader.messages(connections, start, stop):
                yield connection.topic, time, data

    def decode(self, topic: str, data: bytes) -> Any:
        """CDR bytes -> message of the topic's type."""
        with self._readable(f"{topic}: "):
            return self._types.deserialize_cdr(data, self.topics[topic].type)

    @contextmanager
    def _readable(self, where: str = "") -> Iterator[None]:
        # A damaged file makes rosbags stumble wherever the damage is: struct, zstd, sqlite, assertion,
        # memory, key errors.
        try:
            yield
        except CalibrationError:
            raise
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise BadInputError(f"{where}bag {self.path} cannot be read ({reason}); {self._advice}") from error


def _check_metadata(path: Path) -> None:
    """ValueError for a file that refers to parts of itself, for which YAML has aliases and merges."""
    text = path.read_bytes() if path.is_file() else b""
    if MERGED.search(text) or len(ALIAS.findall(text)) > FEW_ALIASES:
        raise ValueError("metadata.yaml refers to parts of itself")


def _topics(connections: Collection[Any]) -> dict[str, Topic]:
    """By name. rosbags takes over whatever stands in metadata.yaml: TypeError where that is no text or no number."""
    counts: dict[str, int] = {}
    for connection in connections:  # one topic may have several connections, one per publisher's QoS
        if not isinstance(connection.topic, str) or not isinstance(connection.msgtype, str):
            raise TypeError("a topic without a name or a type")
        if not isinstance(connection.msgcount, int):
            raise TypeError(f"{connection.topic} has no number of messages")
        counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    types = {connection.topic: connection.msgtype for connection in connections}
    return {name: Topic(name, types[name], count) for name, count in sorted(counts.items())}


def storage_file(path: Path) -> Path:
    """The first storage file of a bag, which tells its format.

    A folder without metadata.yaml (recording interrupted) may hold only one.
    """
    if not path.exists():
        raise BadInputError(f"{path} does not exist; give a bag folder, a .mcap or a .db3 file")
    if path.is_file():
        if path.suffix not in STORAGE:
            raise BadInputError(f"{path} is no ROS 2 bag; give a bag folder, a .mcap or a .db3 file")
        return path
    names = [file for file in sorted(path.iterdir()) if file.is_file()]
    # A compressed bag has names like bag_0.db3.zstd.
    stores = [file for file in names if (file.with_suffix("") if file.suffix == ".zstd" else file).suffix in STORAGE]
    if not stores:
        raise BadInputError(f"bag {path} has no .mcap or .db3 file; copy the whole folder")
    if not (path / "metadata.yaml").exists() and len(stores) > 1:
        raise BadInputError(f"bag {path} has {len(stores)} storage files but no metadata.yaml; run `ros2 bag reindex {path}`")
    first = stores[0]
    return first if first.suffix in STORAGE else first.with_suffix("")


def peek_header(data: bytes) -> tuple[int, str]:
    """Stamp in ns and frame id of a CDR message that begins with a std_msgs/Header; the rest is not read."""
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds, length = struct.unpack_from(order + "iII", data, 4)
    # Some writers of tf1 days kept the leading slash that tf2 forbids.
    frame = bytes(data[16 : 16 + length]).rstrip(b"\0").decode("utf-8", "replace").lstrip("/")
    return seconds * NANOSECONDS + nanoseconds, frame


# The tree of /tf_static: how two of its frames lie to each other.
Matrix = NDArray[np.float64]


class StaticTransforms:
    """Collects tf2_msgs/TFMessage. As in tf2, the latest of a child counts and broken ones are ignored."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Matrix]] = {}  # child -> parent, T_parent_child

    def add(self, msg: Any) -> None:
        """Take over all transforms of a TFMessage (`transforms`: geometry_msgs/TransformStamped)."""
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

    def lookup(self, target: str, source: str) -> Matrix | None:
        """T_target_source (4, 4) through the tree in either direction; None when they are not connected."""
        edges: dict[str, list[tuple[str, Matrix]]] = {}
        for child, (parent, T_parent_child) in list(self._parents.items()):  # another thread may add
            edges.setdefault(parent, []).append((child, T_parent_child))
            edges.setdefault(child, []).append((parent, se3.inverse(T_parent_child)))
        if target not in edges:
            return None
        found = {target: np.eye(4)}
        queue = deque([target])
        while queue:
            frame = queue.popleft()
            if frame == source:
                return found[frame]
            for neighbour, T_frame_neighbour in edges[frame]:
                if neighbour not in found:
                    found[neighbour] = found[frame] @ T_frame_neighbour
                    queue.append(neighbour)
        return None


# One pass over a bag's headers: what is needed to pair its messages and to fetch them again one by one.
TF = "tf2_msgs/msg/TFMessage"


class TopicIndex:
    """Where the messages of one topic are.

    After `finish`, sorted by stamp, all in ns: stamps (n,), the stamps in the headers (n,) and the times of
    recording (n,).
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.frame = ""
        self._found: list[tuple[int, int]] = []  # stamp of the header, time of recording

    def add(self, recorded: int, data: bytes) -> None:
        """Note a message's header."""
        if len(data) < 16:
            raise BadInputError(f"a message has only {len(data)} bytes; record the bag anew")
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
        """Sort by stamp: the header's, or else the time of recording."""
        headers, recorded = np.array(self._found, np.int64).reshape(-1, 2).T
        stamps = headers if use_headers else recorded
        self.order = np.argsort(stamps, kind="stable")
        self.stamps: Stamps = stamps[self.order]
        self.headers: Stamps = headers[self.order]
        self.recorded: Stamps = recorded[self.order]


class BagIndex:
    """Images, clouds, cameras and static transforms of a bag.

    Reads all of it once and keeps some tens of bytes per message.
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
            with naming(bag.path, topic):
                by_topic[topic].add(recorded, data)
                if topic == info_topic:
                    content = bytes(data[12:])  # all but the stamp: nearly always the same, so decoded once
                    if content not in decoded:
                        decoded[content] = decode_camera_info(bag.decode(topic, data), rectified)
                    cameras.append(decoded[content])
        for index in by_topic.values():
            if not len(index):
                raise BadInputError(f"bag {bag.path}: no message on {index.topic} is readable; copy it again or record anew")
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
        """T_camera_lidar (4, 4) as known at a time of recording, None if never.

        Frames recorded before the first transform arrived have the first one.
        """
        if not self._references:
            return None
        known = sum(time <= recorded for time, _ in self._references)
        return self._references[max(known - 1, 0)][1]


def _references(transforms: list[tuple[int, Any]], camera_frame: str, lidar_frame: str) -> list[tuple[int, Matrix]]:
    """T_camera_lidar after each static transform message that changed it, with the time of recording."""
    tree = StaticTransforms()
    known: list[tuple[int, Matrix]] = []
    for recorded, message in transforms:
        tree.add(message)
        T = tree.lookup(camera_frame, lidar_frame)
        if T is not None and not (known and np.array_equal(T, known[-1][1])):
            known.append((recorded, T))
    return known


@contextmanager
def naming(path: Path, where: str) -> Iterator[None]:
    """Say in which bag and where in it an unusable message was met."""
    try:
        yield
    except BadInputError as error:
        raise BadInputError(f"{path}, {where}: {error}") from error


# Which topics of a bag are the camera's image, its CameraInfo and the LiDAR's cloud.
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINTS = "sensor_msgs/msg/PointCloud2"


def choose_image(bag: BagFile, wanted: str | None) -> str:
    """The image topic: the wanted one, or the only one. A raw image wins over its compressed transport."""
    candidates = _with_type(bag, IMAGE, COMPRESSED)
    if wanted is None:
        candidates = [name for name in candidates if not name.endswith("/compressedDepth")]
        transports = {f"{name}/compressed" for name in candidates}
        candidates = [name for name in candidates if name not in transports]
    return _choose(bag, wanted, candidates, "Image or CompressedImage", "image_topic")


def choose_points(bag: BagFile, wanted: str | None) -> str:
    """The cloud topic: the wanted one, or the only one."""
    return _choose(bag, wanted, _with_type(bag, POINTS), "PointCloud2", "points_topic")


def choose_camera_info(bag: BagFile, wanted: str | None, image_topic: str) -> str:
    """The wanted CameraInfo topic, or the one beside the image (image_transport's rule), or the only one."""
    candidates = _with_type(bag, CAMERA_INFO)
    beside = re.sub(r"/compressed$", "", image_topic).rpartition("/")[0] + "/camera_info"
    if wanted is None and beside in candidates:
        return beside
    return _choose(bag, wanted, candidates, "CameraInfo", "camera_info_topic")


def is_rectified(image_topic: str) -> bool:
    """Whether a topic is rectified by image_proc's naming (image_rect, image_rect_color)."""
    return re.search(r"(^|[/_])rect(ified)?($|[/_])", image_topic) is not None


def _with_type(bag: BagFile, *types: str) -> list[str]:
    return [topic.name for topic in bag.topics.values() if topic.type in types and topic.messages > 0]


def _choose(bag: BagFile, wanted: str | None, candidates: list[str], kind: str, option: str) -> str:
    if wanted is not None:
        name = "/" + wanted.strip("/")
        if name in candidates:
            return name
        has = f"it has {', '.join(candidates)}" if candidates else "it has none"
        raise BadInputError(f"bag {bag.path} has no {kind} messages on topic {name}; {has}; set {option} accordingly")
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise BadInputError(
            f"bag {bag.path} has {len(candidates)} topics of type {kind}: {', '.join(candidates)}; choose one with {option}"
        )
    others = ", ".join(f"{topic.name} ({topic.type})" for topic in bag.topics.values()) or "nothing at all"
    raise BadInputError(f"bag {bag.path} has no {kind} messages, only {others}; record that topic too")


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
        self.image_topic = choose_image(self._bag, image_topic)
        self.points_topic = choose_points(self._bag, points_topic)
        self.camera_info_topic = choose_camera_info(self._bag, camera_info_topic, self.image_topic)
        self.rectified = is_rectified(self.image_topic) if rectified is None else rectified
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
        compressed = self._bag.topics[self.image_topic].type == COMPRESSED
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


# Frames -> the messages of rosbags.
# PointField datatypes of numpy's types.
_DATATYPES = {"<f4": 7, "<u2": 4}


class MessageBuilder:
    """Makes messages of a rosbags typestore for one camera and one LiDAR. Stamps are in ns."""

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
        """x, y, z and, if the cloud has them, intensity, ring (uint16) and time (float32 s), without gaps."""
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
                self._types["sensor_msgs/msg/PointField"](name, layout[name][1], _DATATYPES[kind], 1)
                for name, (kind, _) in columns.items()
            ],
            is_bigendian=False,
            point_step=points.itemsize,
            row_step=points.nbytes,
            data=points.view(np.uint8) if len(points) else np.zeros(0, np.uint8),
            is_dense=bool(np.isfinite(cloud.xyz).all()),
        )

    def static_transform(self, stamp: int, T_camera_lidar: NDArray[np.float64]) -> Any:
        """TFMessage camera frame -> LiDAR frame: TF's transform maps points of the child into the parent."""
        x, y, z = (float(v) for v in T_camera_lidar[:3, 3])
        quaternion = (float(v) for v in se3.quaternion_from_rotation(T_camera_lidar[:3, :3]))
        transform = self._types["geometry_msgs/msg/Transform"](
            self._types["geometry_msgs/msg/Vector3"](x, y, z), self._types["geometry_msgs/msg/Quaternion"](*quaternion)
        )
        stamped = self._types["geometry_msgs/msg/TransformStamped"](
            self._header(stamp, self._camera_frame), self._lidar_frame, transform
        )
        return self._types["tf2_msgs/msg/TFMessage"]([stamped])

    def _header(self, stamp: int, frame: str) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](stamp // NANOSECONDS, stamp % NANOSECONDS)
        return self._types["std_msgs/msg/Header"](time, frame)

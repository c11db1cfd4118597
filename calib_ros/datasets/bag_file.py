"""A bag on disk, read through rosbags: its files, of which some may be missing, topics and raw messages, with clear errors."""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from weakref import finalize

from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.storage_mcap import McapReader

from calib_ros import io
from calib_ros.datasets.bag_messages import Raw, heads, layout_of, messages, storages_of, typestore, zstd
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import NANOSECONDS
from calib_ros.messages.point_fields import LIVOX, decode_livox
from calib_ros.messages.wire import wire_header

TF, TF_STATIC = "tf2_msgs/msg/TFMessage", "/tf_static"
METADATA, ZSTD_SUFFIX = "metadata.yaml", ".zstd"
STORAGE = {".mcap": "mcap", ".db3": "sqlite3", ".bag": "ROS 1"}
TOOLS = {"mcap": "recover it with `mcap recover`, ", "ROS 1": "mend it with `rosbag reindex`, "}
# ns, between parts of one recording: a recorder opens the next file where it closes the last one.
MAX_OVERLAP, MAX_PAUSE = NANOSECONDS, 60 * NANOSECONDS
YAML_MERGE, YAML_ALIAS, MAX_ALIASES = re.compile(rb"<<\s*:"), re.compile(rb"[\s\[{,:]\*\w"), 10  # no recorder writes either


class Topic(NamedTuple):
    """A topic of a bag: message type, like "sensor_msgs/msg/Image", and number of messages."""

    name: str
    type: str
    messages: int


class BagFile:
    """An open bag: topics, raw messages, decoding. Not thread-safe. Closes its files on `close` or garbage collection.

    start, stop: recording times of the first message, and after the last, ns. indexed: whether messages of a topic and time are
    found without reading the others, as in an mcap file with chunks and a summary. remarks: on what is not as a recorder leaves
    it, for people. incomplete: use what is left of a bag of which parts are missing, empty or damaged.

    Raises BadInputError for whatever is wrong with its files, when opening or when reading.
    """

    def __init__(self, path: Path, incomplete: bool = False) -> None:
        self.path = path
        if not path.exists():
            raise BadInputError(f"{path} does not exist; give a bag folder, a .mcap, .db3 or .bag file")
        files = [path] if path.is_file() else _storage_files(path)
        if not files:
            raise BadInputError(f"bag {path} has no .mcap, .db3 or .bag file; copy the whole folder")
        self.storage = _storage_of(files[0])
        if not self.storage:
            raise BadInputError(f"{path} is no bag; give a bag folder, a .mcap, .db3 or .bag file")
        self._advice = f"{TOOLS.get(self.storage, '')}copy it again or record it again"
        self._types, stack = typestore(), ExitStack()
        self.close = finalize(self, stack.close)
        try:
            with self._readable():
                described = (path / METADATA).read_bytes() if (path / METADATA).is_file() else b""
                if YAML_MERGE.search(described) or len(YAML_ALIAS.findall(described)) > MAX_ALIASES:
                    raise ValueError(f"{METADATA} refers to parts of itself")  # a few lines expand to millions: rosbags hangs
                self._readers, self.remarks = _opened(path, files, incomplete, stack)
                connections = [connection for reader in self._readers for connection in reader.connections]
                self.topics = _topics(connections)
                self._layouts = {connection.topic: layout_of(connection) for connection in connections}
                filled = [reader for reader in self._readers if reader.message_count]
                self.start = min((reader.start_time for reader in filled), default=0)
                self.stop = max((reader.end_time for reader in filled), default=0)
                self.duration_s = (self.stop - self.start) / NANOSECONDS
                storages = [storage for reader in self._readers for storage in storages_of(reader)]
                self.indexed = all(bool(storage.chunks) for storage in storages if isinstance(storage, McapReader))
        except BaseException:
            self.close()
            raise

    @property
    def size(self) -> int:
        """Of its files, bytes."""
        files = [self.path] if self.path.is_file() else [file for file in self.path.iterdir() if file.is_file()]
        return sum(file.stat().st_size for file in files)

    def period(self, topic: str) -> int:
        """Mean time between the messages of a topic, ns; the length of the bag where there are none."""
        return round((self.stop - self.start) / max(self.topics[topic].messages, 1))

    def raw(self, topics: Collection[str], start: int | None = None, stop: int | None = None) -> Iterator[Raw]:
        """(topic, time of recording in ns, CDR bytes) of messages recorded in [start, stop), in order, part by part."""
        with self._readable():
            for reader in self._readers:
                yield from messages(reader, topics, start, stop)

    def heads(self, topics: Collection[str], whole: Collection[str]) -> Iterator[Raw]:
        """As `raw` of all, about in order, and of topics that are not in `whole` maybe no more than the header."""
        with self._readable():
            for reader in self._readers:
                yield from heads(reader, topics, whole)

    def find(self, topic: str, recorded: int, header: int) -> Any:
        """The decoded message that was recorded and stamped then, ns: several may have been recorded at the same time."""
        for _, _, data in self.raw([topic], recorded, recorded + 1):
            if peek_header(data)[0] == header:
                return self.decode(topic, data)
        raise BadInputError(f"bag {self.path}: a message on {topic} is gone; the bag has changed, open it again")

    @property
    def statics(self) -> list[str]:
        """Topics of static transforms."""
        return [topic.name for topic in self.topics.values() if topic.type == TF and topic.name.endswith(TF_STATIC)]

    def transforms(self) -> list[tuple[int, Any]]:
        """Messages of static transforms, with the time of recording, ns."""
        return [(recorded, self.decode(topic, data)) for topic, recorded, data in self.raw(self.statics)]

    def decode(self, topic: str, data: bytes) -> Any:
        """CDR bytes -> message of the topic's type, of Livox's own type its PointCloud."""
        if self.topics[topic].type in LIVOX:
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
            raise BadInputError(f"{where}bag {self.path} cannot be read ({_reason(error)}); {self._advice}") from error


def peek_header(data: bytes) -> tuple[int, str]:
    """Stamp in ns and frame id of a CDR message that begins with a std_msgs/Header; the rest is not decoded."""
    header = wire_header(data)
    # Some drivers keep the leading slash of tf1, which tf2 forbids.
    return header.stamp, header.frame_id.lstrip("/")


def _opened(path: Path, files: list[Path], incomplete: bool, stack: ExitStack) -> tuple[list[Any], list[str]]:
    """Readers of a bag's files, which the stack closes, and remarks. A folder is read by its metadata.yaml, or, where that is
    missing or does not fit, file by file: of one recording by their times, and, unless `incomplete`, all of it."""
    if path.is_file():
        return [_reader(path, stack)], []
    remarks = []
    if (path / METADATA).exists():
        try:
            return [_reader(path, stack)], []
        except (ReaderError, AssertionError) as error:
            why = _reason(error, "a part is empty or damaged")
            remarks.append(f"bag {path.name}: {METADATA} does not fit its files ({why}), which are read without it")
    readers, lost = [], []
    for file in files:
        try:
            readers.append(_reader(file, stack))
        except Exception as error:  # of a damaged file rosbags raises whatever the damaged place leads to
            lost.append(f"{file.name} ({_reason(error)})")
    if not readers or (lost and len(files) == 1):
        raise ReaderError(", ".join(lost))
    lost += [f"{reader.path.name} (empty)" for reader in readers if len(files) > 1 and not reader.message_count]
    with suppress(Exception):  # a metadata.yaml that does not tell the names of its files
        listed = io.load((path / METADATA).read_text())["rosbag2_bagfile_information"]["relative_file_paths"]
        lost += [f"{name} (missing)" for name in [PurePath(part).name for part in listed] if not (path / name).exists()]
    if lost and not incomplete:
        raise BadInputError(
            f"bag {path}: {len(readers)} parts are there, but not {', '.join(lost)}; copy the whole folder, or use what is "
            "left by --incomplete"
        )
    readers.sort(key=lambda reader: int(reader.start_time))
    for one, other in pairwise([reader for reader in readers if reader.message_count]):
        pause, shorter = other.start_time - one.end_time, min(one.duration, other.duration)
        if pause < -min(MAX_OVERLAP, shorter // 2) or (pause > MAX_PAUSE and not incomplete):
            raise BadInputError(
                f"bag {path}: {one.path.name} and {other.path.name} are not parts of one recording by their times, and no "
                f"{METADATA} says so; open one of the files"
            )
    return readers, remarks + [f"bag {path.name}: without {part}" for part in lost]


def _reader(path: Path, stack: ExitStack) -> Any:
    """The open reader of a folder or file. A compressed file is unpacked to disk."""
    if path.is_file() and path.suffix == ZSTD_SUFFIX:
        plain = Path(stack.enter_context(TemporaryDirectory())) / path.stem
        with path.open("rb") as packed, zstd.open(packed, "rb") as source, plain.open("wb") as target:
            shutil.copyfileobj(source, target)
        path = plain
    reader: Any = Ros1Reader(path) if path.is_file() and path.suffix == ".bag" else Reader(path)
    reader.open()

    def close() -> None:
        with suppress(Exception):
            reader.close()

    stack.callback(close)
    return reader


def _storage_files(folder: Path) -> list[Path]:
    """The files of a folder that hold messages, in order, compressed ones among them."""
    files = [file for file in sorted(folder.iterdir(), key=lambda file: (len(file.name), file.name)) if file.is_file()]
    names = {file.name for file in files}
    # Neither what `rosbag compress` and `reindex` keep of a bag, nor what was decompressed already.
    again = (".orig.bag", ".orig.active")
    kept = [file for file in files if not file.name.startswith(".") and not file.name.endswith(again)]
    return [file for file in kept if _storage_of(file) and not (file.suffix == ZSTD_SUFFIX and file.stem in names)]


def _storage_of(file: Path) -> str:
    """How a file holds messages: "mcap", "sqlite3", "ROS 1", or "" if it holds none."""
    return STORAGE.get((file.with_suffix("") if file.suffix == ZSTD_SUFFIX else file).suffix, "")


def _reason(error: Exception, otherwise: str = "") -> str:
    return " ".join(str(error).split()) or otherwise or type(error).__name__


def _topics(connections: Collection[Any]) -> dict[str, Topic]:
    """Topics by name. TypeError where metadata.yaml, which rosbags does not check, has no text or no number."""
    topics: dict[str, Topic] = {}
    for connection in connections:  # one topic may have several connections, one per publisher's QoS
        name, kind, count = connection.topic, connection.msgtype, connection.msgcount
        if not isinstance(name, str) or not isinstance(kind, str):
            raise TypeError("a topic without a name or a type")
        if not isinstance(count, int):
            raise TypeError(f"{name} has no number of messages")
        topics[name] = Topic(name, kind, count + (topics[name].messages if name in topics else 0))
    return dict(sorted(topics.items()))

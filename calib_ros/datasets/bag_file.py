"""A ROS 2 bag on disk, mcap or sqlite3, read through rosbags: topics, raw messages, clear errors."""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple
from weakref import finalize

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import NANOSECONDS

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

"""The files of a bag: with their metadata.yaml as rosbags reads them, or each for itself; ROS 1 bags as if they were ROS 2's."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Collection, Iterator
from contextlib import ExitStack, suppress
from itertools import pairwise
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.rosbag2.storage_mcap import McapReader

from calib_ros import io
from calib_ros.datasets.bag_heads import ZSTD, heads, storages_with_heads
from calib_ros.datasets.bag_types import cdr_of_ros1
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS

if sys.version_info >= (3, 14):
    from compression import zstd
else:  # what rosbags itself requires
    from backports import zstd

METADATA, COMPRESSED = "metadata.yaml", ".zstd"
STORAGE = {".mcap": "mcap", ".db3": "sqlite3", ".bag": "ROS 1"}
# ns, between parts of one recording: a recorder opens the next file where it closes the last one.
MAX_OVERLAP, MAX_PAUSE = NANOSECONDS, 60 * NANOSECONDS


def storage_files(folder: Path) -> list[Path]:
    """The files of a folder that hold messages, in order, compressed ones among them."""
    files = [file for file in sorted(folder.iterdir(), key=lambda file: (len(file.name), file.name)) if file.is_file()]
    names = {file.name for file in files}
    # Neither what `rosbag compress` and `reindex` keep of a bag, nor what was decompressed already.
    again = (".orig.bag", ".orig.active")
    kept = [file for file in files if not file.name.startswith(".") and not file.name.endswith(again)]
    return [file for file in kept if storage_of(file) and not (file.suffix == COMPRESSED and file.stem in names)]


def storage_of(file: Path) -> str:
    """How a file holds messages: "mcap", "sqlite3", "ROS 1", or "" if it holds none."""
    return STORAGE.get((file.with_suffix("") if file.suffix == COMPRESSED else file).suffix, "")


class BagParts:
    """Open files of a bag. start, stop: recording times of the first message, and after the last, ns. indexed: whether messages
    of a topic and time are found without reading the others. remarks: on what is not as a recorder leaves it, for people.

    incomplete: use what is left of a bag of which parts are missing, empty or damaged; else BadInputError names them.
    """

    def __init__(self, path: Path, incomplete: bool = False) -> None:
        self.remarks: list[str] = []
        self._stack = ExitStack()
        try:
            if path.is_file():
                self._readers = [self._opened(path)]
            else:
                self._readers = self._of_folder(path, incomplete)
        except BaseException:
            self._stack.close()
            raise
        self.connections = [connection for reader in self._readers for connection in reader.connections]
        filled = [reader for reader in self._readers if reader.message_count]
        self.start = min((reader.start_time for reader in filled), default=0)
        self.stop = max((reader.end_time for reader in filled), default=0)
        self.indexed = all(
            not isinstance(storage, McapReader) or bool(storage.chunks)
            for reader in self._readers
            for storage in (getattr(reader.storage, "storages", [reader.storage]) if isinstance(reader, Reader) else ())
        )

    def close(self) -> None:
        """Close all files."""
        self._stack.close()

    def messages(self, topics: Collection[str], start: int | None, stop: int | None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, time of recording in ns, CDR bytes) of messages recorded in [start, stop), part by part."""
        for reader in self._readers:
            yield from _messages(reader, topics, start, stop)

    def heads(self, topics: Collection[str], whole: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """As all `messages`, but only the beginnings of those that are not of the topics `whole`, where that is less to read."""
        for reader in self._readers:
            storages = storages_with_heads(reader)
            if storages is None:
                yield from _messages(reader, topics, None, None)
            else:
                for storage in storages:
                    for topic, time, data in heads(storage, topics, whole):
                        yield topic, time, zstd.decompress(data) if data[:4] == ZSTD else data

    def _of_folder(self, path: Path, incomplete: bool) -> list[Any]:
        parts = storage_files(path)
        if not parts:
            raise BadInputError(f"bag {path} has no .mcap, .db3 or .bag file; copy the whole folder")
        if (path / METADATA).exists():
            try:
                return [self._entered(Reader(path))]
            except (ReaderError, AssertionError) as error:
                why = " ".join(str(error).split()) or "a part is empty or damaged"
                self.remarks.append(f"bag {path.name}: {METADATA} does not fit its files ({why}), which are read without it")
        readers, lost = [], []
        for part in parts:
            try:
                readers.append(self._opened(part))
            except Exception as error:  # of a damaged file rosbags raises whatever the damaged place leads to
                lost.append(f"{part.name} ({' '.join(str(error).split()) or type(error).__name__})")
        if not readers or (lost and len(parts) == 1):
            raise ReaderError(", ".join(lost))
        lost += [f"{reader.path.name} (empty)" for reader in readers if len(parts) > 1 and not reader.message_count]
        lost += [f"{name} (missing)" for name in _listed(path / METADATA) if not (path / name).exists()]
        if lost and not incomplete:
            raise BadInputError(
                f"bag {path}: {len(readers)} parts are there, but not {', '.join(lost)}; copy the whole folder, or use what is "
                "left by --incomplete"
            )
        self.remarks += [f"bag {path.name}: without {part}" for part in lost]
        readers.sort(key=lambda reader: int(reader.start_time))
        filled = [reader for reader in readers if reader.message_count]
        for one, other in pairwise(filled):
            pause, shorter = other.start_time - one.end_time, min(one.duration, other.duration)
            if pause < -min(MAX_OVERLAP, shorter // 2) or (pause > MAX_PAUSE and not incomplete):
                raise BadInputError(
                    f"bag {path}: {one.path.name} and {other.path.name} are not parts of one recording by their times, and no "
                    f"{METADATA} says so; open one of the files"
                )
        return readers

    def _opened(self, file: Path) -> Any:
        if file.suffix == COMPRESSED:
            folder = self._stack.enter_context(TemporaryDirectory())
            plain = Path(folder) / file.stem
            with file.open("rb") as packed, zstd.open(packed, "rb") as source, plain.open("wb") as target:
                shutil.copyfileobj(source, target)
            file = plain
        return self._entered(Ros1Reader(file) if file.suffix == ".bag" else Reader(file))

    def _entered(self, reader: Any) -> Any:
        reader.open()
        self._stack.callback(_close, reader)
        return reader


def _messages(reader: Any, topics: Collection[str], start: int | None, stop: int | None) -> Iterator[tuple[str, int, bytes]]:
    connections = [c for c in reader.connections if c.topic in topics]
    if not connections:  # rosbags reads an empty list as "all"
        return
    is_ros1 = isinstance(reader, Ros1Reader)
    for connection, time, data in reader.messages(connections, start, stop):
        if is_ros1:
            data = cdr_of_ros1(data, connection)
        elif data[:4] == ZSTD:
            data = zstd.decompress(data)
        yield connection.topic, time, data


def _listed(metadata: Path) -> list[str]:
    """Names of the files that a bag should have; none where its metadata.yaml does not tell."""
    with suppress(Exception):
        paths = io.load(metadata.read_text())["rosbag2_bagfile_information"]["relative_file_paths"]
        return [PurePath(path).name for path in paths]
    return []


def _close(reader: Any) -> None:
    with suppress(Exception):
        reader.close()

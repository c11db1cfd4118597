"""The messages of a bag as CDR, whole or only their beginnings (of a recording of 20 GB some 1 %), and their types."""

from __future__ import annotations

import heapq
import os
import struct
import sys
from collections.abc import Collection, Iterator
from functools import cache
from typing import Any

from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag1.reader import Header, RecordType, decompressors, read_bytes, read_uint32
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from calib_ros.messages.compressed_points import CLOUD_DEFINITION, COMPRESSED_POINTS
from calib_ros.messages.point_fields import CUSTOM_MSG, CUSTOM_POINT, LIVOX
from calib_ros.messages.video import FORMER_DEFINITION, FORMER_PACKET, VIDEO

if sys.version_info >= (3, 14):
    from compression import zstd as zstd
else:  # what rosbags itself requires
    from backports import zstd as zstd

Raw = tuple[str, int, bytes]  # topic, time of recording in ns, CDR
ZSTD = b"\x28\xb5\x2f\xfd"  # begins what is compressed; a message begins with 0 and its byte order
HEAD = 512  # bytes: a stamp and a name of a frame
MESSAGE, MESSAGE_INDEX = 0x05, 0x07  # records of mcap
RECORD = struct.Struct("<BQ")  # its kind, its length
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, number, times of recording and of publishing
CHUNK_HEAD = 40  # bytes before the name of its compression, which is empty: times, size, checksum, two lengths


@cache
def typestore() -> Typestore:
    """The message types of ROS 2, the same in every release: a bag's own definitions, maybe broken, are not needed."""
    store = get_typestore(Stores.ROS2_KILTED)
    for name in LIVOX:
        package = name.partition("/")[0]
        store.register(get_types_from_msg(CUSTOM_POINT, f"{package}/msg/CustomPoint"))
        store.register(get_types_from_msg(CUSTOM_MSG, name))
    for name, definition in {**VIDEO, FORMER_PACKET: FORMER_DEFINITION, COMPRESSED_POINTS: CLOUD_DEFINITION}.items():
        store.register(get_types_from_msg(definition, name))
    return store


def layout_of(connection: Any) -> str:
    """The type of `typestore` by which a connection's messages are decoded: of a name that has had two, by its definition."""
    former = connection.msgtype.endswith("/FFMPEGPacket") and "img_width" in connection.msgdef.data
    return FORMER_PACKET if former else str(connection.msgtype)


def storages_of(reader: Any) -> list[Any]:
    """The open files of a reader of rosbags; that of ROS 1 is one."""
    storage: Any = reader.storage if isinstance(reader, Reader) else reader
    return list(getattr(storage, "storages", [storage]))


def messages(reader: Any, topics: Collection[str], start: int | None = None, stop: int | None = None) -> Iterator[Raw]:
    """Messages of a reader recorded in [start, stop), in order."""
    connections = [c for c in reader.connections if c.topic in topics]
    if not connections:  # rosbags reads an empty list as "all"
        return
    is_ros1 = isinstance(reader, Ros1Reader)
    for connection, time, data in reader.messages(connections, start, stop):
        yield connection.topic, time, _cdr_of_ros1(data, connection) if is_ros1 else _inflated(data)


def heads(reader: Any, topics: Collection[str], whole: Collection[str]) -> Iterator[Raw]:
    """All `messages`, in about their order: all bytes of topics in `whole` and of what is compressed, of others the beginning;
    as they are where chunks are compressed, which have to be read as a whole."""
    storages = storages_of(reader)
    if not all(map(_has_heads, storages)):
        yield from messages(reader, topics)
        return
    for storage in storages:
        if isinstance(storage, Ros1Reader):
            yield from _of_ros1(storage, topics, whole)
        else:
            wanted = {c.id: (c.topic, c.topic in whole) for c in storage.connections if c.topic in topics}
            for topic, time, data in (_of_mcap if isinstance(storage, McapReader) else _of_sqlite)(storage, wanted):
                yield topic, time, _inflated(data)


def _inflated(data: bytes) -> bytes:
    return zstd.decompress(data) if data[:4] == ZSTD else data


def _cdr_of_ros1(data: bytes, connection: Any) -> bytes:
    return bytes(typestore().ros1_to_cdr(data, layout_of(connection)))


def _has_heads(storage: Any) -> bool:
    if isinstance(storage, Ros1Reader):
        return all(chunk.decompressor is decompressors["none"] for chunk in storage.chunks.values())
    if isinstance(storage, McapReader):
        return bool(storage.chunks) and all(not c.compression and c.message_index_offsets for c in storage.chunks)
    return isinstance(storage, Sqlite3Reader)


def _of_mcap(storage: Any, wanted: dict[int, tuple[str, bool]]) -> Iterator[Raw]:
    file = storage.bio.fileno()  # not through its buffer, which would read more
    for chunk in sorted(storage.chunks, key=lambda chunk: int(chunk.message_start_time)):
        begin = chunk.chunk_start_offset + RECORD.size + CHUNK_HEAD
        entries = []
        for channel, at in chunk.message_index_offsets.items():
            if channel in wanted:
                kind, size = RECORD.unpack(os.pread(file, RECORD.size, at))
                if kind != MESSAGE_INDEX or not 6 <= size <= chunk.message_index_length:
                    raise ValueError("an index of messages is damaged")
                entries += [
                    (*entry, channel) for entry in struct.iter_unpack("<QQ", os.pread(file, size - 6, at + RECORD.size + 6))
                ]
        for time, offset, channel in sorted(entries):
            topic, is_whole = wanted[channel]
            data = os.pread(file, RECORD.size + MESSAGE_HEAD.size + HEAD, begin + offset)
            kind, size = RECORD.unpack_from(data)
            if kind != MESSAGE or MESSAGE_HEAD.unpack_from(data, RECORD.size)[::2] != (channel, time):
                raise ValueError("an index of messages is damaged")
            content = RECORD.size + MESSAGE_HEAD.size
            length = min(size - MESSAGE_HEAD.size, chunk.uncompressed_size)
            if (is_whole or data[content : content + 4] == ZSTD) and length > HEAD:
                data += os.pread(file, length - HEAD, begin + offset + len(data))
            yield topic, time, data[content : content + length]


def _of_sqlite(storage: Any, wanted: dict[int, tuple[str, bool]]) -> Iterator[Raw]:
    ids = ",".join(map(str, wanted))
    rows = storage.dbconn.cursor().execute(
        f"SELECT id, topic_id, timestamp FROM messages WHERE topic_id IN ({ids}) ORDER BY timestamp"
    )
    for row, channel, time in rows:
        topic, is_whole = wanted[channel]
        with storage.dbconn.blob_open("main", "messages", "data", row, False) as blob:
            data = blob.read(HEAD)
            yield topic, time, data + blob.read() if is_whole or data[:4] == ZSTD else data


def _of_ros1(reader: Ros1Reader, topics: Collection[str], whole: Collection[str]) -> Iterator[Raw]:
    wanted = {c.id: c for c in reader.connections if c.topic in topics}
    file = reader.bio
    assert file is not None
    for entry in heapq.merge(*(reader.indexes[i] for i in wanted)):
        file.seek(reader.chunks[entry.chunk_pos].datapos + entry.offset)
        record = Header.read(file)
        while record.get_uint8("op") == RecordType.CONNECTION:  # a description of the topic, before its first message
            file.seek(read_uint32(file), os.SEEK_CUR)
            record = Header.read(file)
        if record.get_uint8("op") != RecordType.MSGDATA or record.get_uint32("conn") not in wanted:
            raise ValueError("an index of messages is damaged")
        connection, size = wanted[record.get_uint32("conn")], read_uint32(file)
        fields = typestore().fielddefs[layout_of(connection)][1]
        is_whole = connection.topic in whole or not fields or fields[0][0] != "header"
        data = read_bytes(file, size if is_whole else min(size, HEAD))
        if is_whole:
            yield connection.topic, entry.time, _cdr_of_ros1(data, connection)
            continue
        # In ROS 2 the header has no number, and the name of a frame ends by a zero.
        seconds, nanoseconds, length = struct.unpack_from("<III", data, 4)
        header = struct.pack("<III", seconds, nanoseconds, length + 1) + data[16 : 16 + length]
        yield connection.topic, entry.time, b"\0\1\0\0" + header + b"\0"

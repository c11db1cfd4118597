"""The beginnings of a bag's messages, without what follows: of a recording of 20 GB some 1 %."""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from typing import Any

from rosbags.rosbag2 import Reader
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

ZSTD = b"\x28\xb5\x2f\xfd"  # begins what is compressed; a message begins with 0 and its byte order
HEAD = 512  # bytes: a stamp and a name of a frame
MESSAGE, MESSAGE_INDEX = 0x05, 0x07  # records of mcap
RECORD = struct.Struct("<BQ")  # its kind, its length
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, number, times of recording and of publishing
CHUNK_HEAD = 40  # bytes before the name of its compression, which is empty: times, size, checksum, two lengths


def storages_with_heads(reader: Any) -> list[Any] | None:
    """The files of a reader of rosbags, None if their messages have to be read as a whole: of ROS 1, or in compressed chunks."""
    if not isinstance(reader, Reader):
        return None
    storage: Any = reader.storage
    storages = getattr(storage, "storages", [storage])
    return storages if all(_has_heads(one) for one in storages) else None


def _has_heads(storage: Any) -> bool:
    if isinstance(storage, McapReader):
        return bool(storage.chunks) and all(not c.compression and c.message_index_offsets for c in storage.chunks)
    return isinstance(storage, Sqlite3Reader)


def heads(storage: Any, topics: Collection[str], whole: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
    """(topic, time of recording in ns, bytes) of messages, in about their order: all bytes of topics in `whole`
    and of what is compressed, of others the beginning."""
    wanted = {c.id: (c.topic, c.topic in whole) for c in storage.connections if c.topic in topics}
    return _of_mcap(storage, wanted) if isinstance(storage, McapReader) else _of_sqlite(storage, wanted)


def _of_mcap(storage: Any, wanted: dict[int, tuple[str, bool]]) -> Iterator[tuple[str, int, bytes]]:
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


def _of_sqlite(storage: Any, wanted: dict[int, tuple[str, bool]]) -> Iterator[tuple[str, int, bytes]]:
    ids = ",".join(map(str, wanted))
    rows = storage.dbconn.cursor().execute(
        f"SELECT id, topic_id, timestamp FROM messages WHERE topic_id IN ({ids}) ORDER BY timestamp"
    )
    for row, channel, time in rows:
        topic, is_whole = wanted[channel]
        with storage.dbconn.blob_open("main", "messages", "data", row, False) as blob:
            data = blob.read(HEAD)
            yield topic, time, data + blob.read() if is_whole or data[:4] == ZSTD else data

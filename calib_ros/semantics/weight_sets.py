"""Which weights a network runs with: name, licence and fingerprint, so that whoever ships a vehicle can tell what is in it.

Known without loading the network: the node says so when it starts, long before the first image.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from calib_ros.config.semantics import BUILTIN

SHOWN = 12  # digits of a SHA-256: enough to tell files apart, and to read aloud
# Of the protocol buffers of ONNX: the field of ModelProto with its metadata, and those of an entry.
METADATA, KEY, VALUE = 14, 1, 2
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5


@dataclass(frozen=True)
class WeightSet:
    """The weights of a network. licence: as its file states it, empty = not at all. sha256: of the file, in hexadecimal."""

    name: str
    licence: str
    sha256: str

    @property
    def text(self) -> str:
        """In a line, such as "streets (Apache-2.0; SHA-256 0123456789ab)"."""
        return f"{self.name} ({self.licence or 'licence not stated'}; SHA-256 {self.sha256[:SHOWN]})"


def of_package() -> Path:
    """The ONNX file of the package's own weights; their licence lies beside it."""
    return Path(__file__).parent / "weights" / "streets.onnx"


def file_of(choice: str) -> Path:
    """The ONNX file that a value of semantics.image_classes names."""
    return of_package() if choice == BUILTIN else Path(choice)


def weights_of(path: Path) -> WeightSet | None:
    """The weights in an ONNX file, named by its metadata, else by the file; None if there is no such file."""
    try:
        seen = path.stat()
        return _read(path, seen.st_mtime_ns) if path.is_file() else None
    except (OSError, ValueError):  # ValueError: an empty file cannot be mapped
        return None


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal. Raises OSError."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@lru_cache(maxsize=16)
def _read(path: Path, changed_ns: int) -> WeightSet:
    """weights_of, once as long as the file does not change. Raises OSError."""
    data = np.memmap(path, np.uint8, "r").data  # encoders have hundreds of megabytes
    own = metadata_of(data)
    return WeightSet(own.get("name") or path.stem, own.get("license", ""), hashlib.sha256(data).hexdigest())


def metadata_of(data: bytes | memoryview) -> dict[str, str]:
    """Metadata of an ONNX file by their keys, without the libraries that run it; empty for what is none."""
    try:
        entries = [dict(_fields(entry)) for number, entry in _fields(data) if number == METADATA]
        return {bytes(entry[KEY]).decode(): bytes(entry.get(VALUE, b"")).decode() for entry in entries}
    except (IndexError, KeyError, ValueError):
        return {}


def _fields(data: bytes | memoryview) -> Iterator[tuple[int, bytes | memoryview]]:
    """Number and content of the fields of a message that hold bytes. IndexError or ValueError for what is no message."""
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == VARINT:
            _, at = _varint(data, at)
        elif kind in (FIXED64, FIXED32):
            at += 8 if kind == FIXED64 else 4
        elif kind == BYTES:
            size, at = _varint(data, at)
            if at + size > len(data):
                raise ValueError("cut off")
            yield tag >> 3, data[at : at + size]
            at += size
        else:
            raise ValueError(f"no field of kind {kind}")


def _varint(data: bytes | memoryview, at: int) -> tuple[int, int]:
    """A number of seven bits per byte, and where it ends."""
    number, shift = 0, 0
    while True:
        byte = data[at]
        number |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if not byte & 0x80:
            return number, at

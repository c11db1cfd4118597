"""Files that are whole or absent, never half written."""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import time
from pathlib import Path
from typing import Any

import yaml

from calib_ros.errors import BadInputError

PARTIAL = ".partial"  # how the names of temporary siblings end
ABANDONED_S = 600.0  # a temporary sibling older than this has lost its writer: no write takes so long


def write_atomically(path: str | Path, data: bytes) -> None:
    """Write to a temporary sibling, flush to disk, rename over `path`. BadInputError if the folder cannot be written.

    The file has mode 0644, whoever runs this may share it. Killed at any moment, or without power, it leaves the old file or the
    new one; temporary siblings of killed writers go with a later write. A link is followed, and what is no regular file (a
    pipe, /dev/null) is written to: a rename would put a file in its place.
    """
    path = Path(os.path.realpath(path))
    temporary = None
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_bytes(data)
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_abandoned(path)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=PARTIAL)
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
        temporary = None
        _flush_folder(path.parent)
    except OSError as error:
        raise BadInputError(f"cannot write {path}: {error.strerror}; check the folder, its permissions and free space") from None
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


def _remove_abandoned(path: Path) -> None:
    """Before the write: on a full disk they may be what fills it."""
    ours = re.compile(re.escape(f".{path.name}.") + r"[a-z0-9_]{8}" + re.escape(PARTIAL))
    for name in os.listdir(path.parent):
        if ours.fullmatch(name):
            with contextlib.suppress(OSError):  # another writer was quicker, or it is a folder
                if time.time() - os.lstat(path.parent / name).st_mtime > ABANDONED_S:
                    os.unlink(path.parent / name)


def _flush_folder(folder: Path) -> None:
    """The new name, too, is on disk only when its folder is. Not every file system can: the file itself is whole in any case."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


# YAML as ROS 2 reads it: plain values under plain names, no aliases. Files that say more than they hold are refused.
MAX_BYTES = 1_000_000  # a result of 10 000 frames; PyYAML takes seconds for it
LARGEST = 10**1000


def read_text(path: str | Path, kind: str, wanted: str) -> str:
    """A text file, UTF-8. BadInputError, saying what is `wanted`, if it cannot be read, is no text or too large."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise BadInputError(f"cannot read {kind} {path}: {error.strerror}") from None
    except ValueError:  # a zero byte in the name
        raise BadInputError(f"cannot read {kind} {str(path)!r}: no file can have this name") from None
    if len(data) > MAX_BYTES:
        raise BadInputError(f"{kind} {path} has more than {MAX_BYTES} bytes; give {wanted}")
    try:
        return data.decode("utf-8-sig")  # editors on Windows put a mark in front
    except UnicodeDecodeError:
        raise BadInputError(f"{path} is not a text file in UTF-8, so not valid YAML or JSON; give {wanted}") from None


def load(text: str) -> Any:
    """The value of a YAML text. yaml.YAMLError, with the place, or ValueError or RecursionError for what is none."""
    return yaml.load(text, _Loader)


class _Loader(yaml.SafeLoader):
    """Without aliases a document is as large as its text: a few hundred bytes of them can stand for 10^9 values."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "aliases are not supported", event.start_mark)
        return super().compose_node(parent, index)

    def integer(self, node: Any) -> int:
        """A whole number. Python can hold one of more than 4300 digits, but not print it."""
        value = self.construct_yaml_int(node)
        if abs(value) > LARGEST:
            raise yaml.constructor.ConstructorError(None, None, "a number of more than 1000 digits", node.start_mark)
        return int(value)

    def mapping(self, node: Any) -> Any:
        """Names on one line, and their values."""
        for name, _ in node.value:
            if not isinstance(name, yaml.ScalarNode) or len(name.value.splitlines()) > 1 or len(name.value) > 200:
                raise yaml.constructor.ConstructorError(None, None, "a key that is no name", name.start_mark)
        return self.construct_yaml_map(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.integer)
_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.mapping)

"""Files: written completely or not at all, and YAML read as ROS 2 reads it."""

from __future__ import annotations

import contextlib
import json
import os
import re
import tempfile
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import yaml

from calib_ros.errors import BadInputError

PARTIAL = ".partial"  # suffix of temporary files
ABANDONED_S = 600.0  # s; older temporary files belong to killed writers: no write takes so long
MAX_BYTES = 1_000_000  # of a text file: a result of 10 000 frames, for which PyYAML takes seconds
MAX_INTEGER = 10**1000


def write_atomically(path: str | Path, data: bytes) -> None:
    """Write to a temporary file in the same folder, flush to disk, rename to `path`: a kill or power loss at any moment leaves
    the old file or the new one.

    The file has mode 0644. Links are followed; what is not a regular file (a pipe, /dev/null) is written to directly. Raises
    BadInputError if the folder cannot be written.
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
        flush(path.parent)
    except OSError as error:
        raise BadInputError(f"cannot write {path}: {error.strerror}; check the folder, its permissions and free space") from None
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)


class AsJson(ABC):
    """What is written as JSON."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Plain values."""

    def dumps(self) -> str:
        """JSON."""
        return json.dumps(self.to_dict(), indent=1) + "\n"

    def save(self, path: str | Path) -> None:
        """Write JSON atomically. BadInputError if the folder cannot be written."""
        write_atomically(path, self.dumps().encode())


def check_output(path: str | Path, option: str) -> None:
    """Before the work whose outcome a file named by an option will hold: make its folder. BadInputError if none can be there."""
    if not str(path):
        raise BadInputError(f"{option} is given without a name; name a file, or leave {option} out")
    path = Path(os.path.realpath(path))
    if path.is_dir():
        raise BadInputError(f"{option} {path} is a folder; name a file")
    make_folder(path.parent, option)
    if not os.access(path if path.exists() and not path.is_file() else path.parent, os.W_OK):
        raise BadInputError(f"{option} {path} cannot be written: no permission; name another file")


def make_folder(path: str | Path, option: str) -> None:
    """Make a folder named by an option, or that of a file. BadInputError if it cannot be made."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise BadInputError(f"{option}: {path} is a file, not a folder; name another") from None
    except OSError as error:
        raise BadInputError(f"{option}: the folder {path} cannot be made ({error.strerror}); name another") from None


def _remove_abandoned(path: Path) -> None:
    """Remove temporary files of killed writers, before the write: they may be what fills a full disk."""
    ours = re.compile(re.escape(f".{path.name}.") + r"[a-z0-9_]{8}" + re.escape(PARTIAL))
    for name in os.listdir(path.parent):
        if ours.fullmatch(name):
            with contextlib.suppress(OSError):  # removed by another writer, or a folder
                if time.time() - os.lstat(path.parent / name).st_mtime > ABANDONED_S:
                    os.unlink(path.parent / name)


def flush(path: Path) -> None:
    """Flush to disk a file, or a folder, which holds names. Not all file systems can the latter; files are complete then, too."""
    with contextlib.suppress(OSError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def read_text(path: str | Path, kind: str, wanted: str) -> str:
    """Content of a UTF-8 text file. BadInputError, naming what is `wanted`, if it is unreadable, not text or too large."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise BadInputError(f"cannot read {kind} {path}: {error.strerror}; give {wanted}") from None
    except ValueError:  # a zero byte in the name
        raise BadInputError(f"cannot read {kind} {str(path)!r}: no file can have this name") from None
    if len(data) > MAX_BYTES:
        raise BadInputError(f"{kind} {path} has more than {MAX_BYTES} bytes; give {wanted}")
    try:
        return data.decode("utf-8-sig")  # editors on Windows write a byte order mark
    except UnicodeDecodeError:
        raise BadInputError(f"{path} is not a text file in UTF-8, so not valid YAML or JSON; give {wanted}") from None


def load(text: str) -> Any:
    """The value of a YAML text: plain values under plain names, no aliases. Raises yaml.YAMLError, ValueError, RecursionError."""
    return yaml.load(text, _Loader)


def compose(text: str) -> yaml.Node | None:
    """The nodes of a YAML text with their places in it; otherwise as `load`."""
    return yaml.compose(text, _Loader)


def what_is_wrong(error: Exception) -> str:
    """Line and cause of what `load` raised, as far as they are known: " in line 3 (why)"."""
    where, why = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    line = f" in line {where.line + 1}" if where is not None else ""
    return f"{line} ({why})" if why else line


class _Loader(yaml.SafeLoader):
    """Safe loader without aliases: a few hundred bytes of them can stand for 10^9 values."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "aliases are not supported", event.start_mark)
        return super().compose_node(parent, index)

    def integer(self, node: Any) -> int:
        """An integer. Python cannot print one of more than 4300 digits."""
        value = self.construct_yaml_int(node)
        if abs(value) > MAX_INTEGER:
            raise yaml.constructor.ConstructorError(None, None, "a number of more than 1000 digits", node.start_mark)
        return int(value)

    def mapping(self, node: Any) -> Any:
        """A mapping with names of one line."""
        for name, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if not isinstance(name, yaml.ScalarNode) or len(name.value.splitlines()) > 1 or len(name.value) > 200:
                raise yaml.constructor.ConstructorError(None, None, "a key that is no name", name.start_mark)
        return self.construct_yaml_map(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.integer)
for kind in ("map", "opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{kind}", _Loader.mapping)

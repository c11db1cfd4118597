"""Files that are whole or absent, never half written."""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
import time
from pathlib import Path

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

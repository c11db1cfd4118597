"""Files that are whole or absent, never half written."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from calib_ros.errors import BadInputError


def write_atomically(path: str | Path, data: bytes) -> None:
    """Write to a temporary sibling, flush to disk, rename over `path`. BadInputError if the folder cannot be written.

    A link is followed, and what is no regular file (a pipe, /dev/null) is written to: a rename would put a file in its place.
    """
    path = Path(os.path.realpath(path))
    temporary = None
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            path.write_bytes(data)
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        raise BadInputError(f"cannot write {path}: {error.strerror}; check the folder, its permissions and free space") from None
    finally:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)

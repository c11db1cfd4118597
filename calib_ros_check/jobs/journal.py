"""Jobs, and the journal of their answers on disk: what is killed resumes where it stopped."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_check.outcome import plain

Answer = dict[str, Any]  # what a job found, as JSON has it: numbers, texts, lists and dictionaries; None for NaN


class Job(Protocol):
    """A piece of work: a dataclass whose values JSON has."""

    @property
    def key(self) -> str:
        """The same for the same piece of work, whoever makes it up; no other has it."""


NAME = "results.jsonl"
BEGINNING = b'{"about":'  # of every journal
FLUSH_S = 5.0  # at most so much work is lost with the power; a killed process loses none
SHOWN = 60  # characters of a value in an error


class Journal:
    """Answers of finished jobs in the file results.jsonl of `folder`, which is made if it is missing; a context manager.

    The first line holds `about`, what the answers depend on (JSON values), and who wrote it; each further one a job and its
    answer. An existing file is gone on with if its `about` is the same, or emptied if `fresh`. One process at a time has it.

    what: who writes it. The journal of another one is never emptied.

    done: key of a job -> its answer, as JSON gives it back. notes: what was wrong with the file, and what was done about it.
    Raises BadInputError for a folder that cannot be written or that another process has, for the journal of another `what`,
    another `about`, or a damaged first line.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any], fresh: bool = False, what: str = "evaluation"):
        self.path, self._what = Path(folder) / NAME, what
        self.done: dict[str, Answer] = {}
        self.notes: list[str] = []
        self._flushed = time.monotonic()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        except OSError as error:
            raise BadInputError(f"cannot write {self.path}: {error.strerror}; choose another folder with --out") from None
        try:
            self._lock()
            self._open(plain(about), fresh)
        except BaseException:
            os.close(self._file)
            raise

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadInputError(
                f"{self.path.parent}: another {self._what} is writing there; wait until it ends, or choose another --out"
            ) from None
        except OSError as error:
            raise BadInputError(
                f"cannot lock {self.path}: {error.strerror}; choose a folder on a local disk with --out"
            ) from None

    def _open(self, about: dict[str, Any], fresh: bool) -> None:
        """Nothing in the file is touched before it is known to be a journal."""
        with open(self._file, "rb", closefd=False) as stream:
            data = stream.read()
        entry = _object(data.partition(b"\n")[0])
        if data[: len(BEGINNING)] != BEGINNING[: len(data)] or entry.get("by", self._what) != self._what:
            article = "an" if self._what[0] in "aeiou" else "a"
            raise BadInputError(f"{self.path} was not written by {article} {self._what}; choose another --out, or move it away")
        whole = 0 if fresh else data.rfind(b"\n") + 1
        lines = data[:whole].splitlines()
        if lines:
            first = _object(lines[0])
            if "about" not in first:
                raise BadInputError(f"{self.path}: line 1 is damaged; choose another --out, or --fresh to begin anew")
            different = _difference(first["about"], about)
            if different:
                raise BadInputError(
                    f"{self.path} belongs to another {self._what}: {different}; choose another --out, or --fresh to begin anew"
                )
        if whole < len(data):
            os.ftruncate(self._file, whole)
            if not fresh:
                self.notes.append(f"{self.path}: the last line was cut off and is dropped; its job is done again")
        if not lines:
            self._append({"about": about, "by": self._what})
        for number, line in enumerate(lines[1:], 2):
            entry = _object(line)
            if isinstance(entry.get("key"), str) and isinstance(entry.get("answer"), dict):
                self.done[entry["key"]] = entry["answer"]
            else:
                self.notes.append(f"{self.path}: line {number} is damaged and left out; its job is done again")

    def add(self, job: Job, answer: Answer) -> None:
        """Write one finished job. Numbers that are NaN or infinite become None. CalibrationError if the disk is full."""
        self._append({"key": job.key, "job": job, "answer": answer})
        if time.monotonic() - self._flushed > FLUSH_S:
            os.fsync(self._file)
            self._flushed = time.monotonic()

    def _append(self, entry: dict[str, Any]) -> None:
        """One write for the whole line, so that a kill leaves it whole or absent."""
        line = json.dumps(plain(entry), allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"
        end = os.fstat(self._file).st_size
        try:
            written = os.write(self._file, line)
            why = "" if written == len(line) else "no space left"
        except OSError as error:
            why = error.strerror or str(error)
        if why:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file, end)
            raise CalibrationError(f"cannot write {self.path}: {why}; free some space, the same command goes on where it stopped")
        if "key" in entry:
            self.done[entry["key"]] = json.loads(line)["answer"]  # as a later run reads it

    def close(self) -> None:
        """Flush to disk, and let others have the file."""
        os.fsync(self._file)
        os.close(self._file)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _object(line: bytes) -> dict[str, Any]:
    """The JSON object of a line; empty if it holds none."""
    try:
        value = json.loads(line)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def _difference(before: Any, now: Any, name: str = "") -> str:
    """Name and both values of the first thing in which two `about` differ; empty if they are the same."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in [*now, *(key for key in before if key not in now)]:
            inner = _difference(before.get(key), now.get(key), f"{name}.{key}".lstrip("."))
            if inner:
                return inner
        return ""
    return "" if before == now else f"{name} was {_short(before)}, is now {_short(now)}"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."

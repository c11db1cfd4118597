"""Jobs, and the journal of their answers on disk: what is killed resumes where it stopped."""

from __future__ import annotations

import errno
import fcntl
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_check.outcome import plain

Answer = dict[str, Any]  # what a job found, as JSON has it: numbers, texts, lists and dictionaries; None for NaN


class Job(Protocol):
    """A piece of work: a dataclass whose values JSON has. key: the same for the same work, and no other."""

    @property
    def key(self) -> str: ...


NAME = "results.jsonl"
BEGINNING = b'{"about":'  # of every journal
SHOWN = 60  # characters of a value in an error


class Journal:
    """Answers of finished jobs in the file results.jsonl of `folder`, which is made if it is missing; a context manager.

    The first line holds `about`, what the answers depend on (JSON values), and `what` wrote it; each further one a job and its
    answer. An existing file is gone on with if its `about` is the same, or emptied if `fresh`, but never that of another `what`.
    One process at a time has it. done: key of a job -> its answer. notes: what was wrong with the file, and what was done about
    it. Raises BadInputError for a folder that cannot be written or that another process has, for the journal of another `what`,
    another `about`, or a damaged first line.
    """

    def __init__(self, folder: Path, about: Mapping[str, Any], fresh: bool = False, what: str = "evaluation"):
        self.path, self._what = Path(folder) / NAME, what
        self.done: dict[str, Answer] = {}
        self.notes: list[str] = []
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("a+b", buffering=0)
        except OSError as error:
            raise BadInputError(f"cannot write {self.path}: {error.strerror}; choose another folder with --out") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._open(plain(about), fresh)
        except BaseException as error:
            self._file.close()
            if not isinstance(error, OSError):
                raise
            busy = isinstance(error, BlockingIOError)
            why = f"another {what} is writing there; wait until it ends" if busy else f"cannot lock it: {error.strerror}"
            raise BadInputError(f"{self.path.parent}: {why}, or choose another folder with --out") from None

    def _open(self, about: dict[str, Any], fresh: bool) -> None:
        """Nothing in the file is touched before it is known to be a journal."""
        self._file.seek(0)
        data, advice = self._file.read(), "choose another --out, or --fresh to begin anew"
        by = _object(data.partition(b"\n")[0]).get("by", self._what)
        if data[: len(BEGINNING)] != BEGINNING[: len(data)] or by != self._what:
            raise BadInputError(f"{self.path} was not written by this {self._what}; choose another --out, or move it away")
        whole = 0 if fresh else data.rfind(b"\n") + 1
        entries = [_object(line) for line in data[:whole].splitlines()]
        if entries and "about" not in entries[0]:
            raise BadInputError(f"{self.path}: line 1 is damaged; {advice}")
        if entries and (different := _difference(entries[0]["about"], about)):
            raise BadInputError(f"{self.path} belongs to another {self._what}: {different}; {advice}")
        if whole < len(data):
            self._file.truncate(whole)
            self.notes += [] if fresh else [f"{self.path}: the last line was cut off and is dropped; its job is done again"]
        if not entries:
            self._append({"about": about, "by": self._what})
        for number, entry in enumerate(entries[1:], 2):
            if isinstance(entry.get("key"), str) and isinstance(entry.get("answer"), dict):
                self.done[entry["key"]] = entry["answer"]
            else:
                self.notes.append(f"{self.path}: line {number} is damaged and left out; its job is done again")

    def add(self, job: Job, answer: Answer) -> None:
        """Write one finished job. Numbers that are NaN or infinite become None. CalibrationError if the disk is full."""
        self.done[job.key] = self._append({"key": job.key, "job": job, "answer": answer})["answer"]

    def _append(self, entry: dict[str, Any]) -> dict[str, Any]:
        """One write for the whole line, so that a kill leaves it whole or absent. The entry as a later run reads it."""
        line = json.dumps(plain(entry), allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"
        try:
            if self._file.write(line) != len(line):  # it is dropped the next time
                raise OSError(errno.ENOSPC, "no space left")
        except OSError as error:
            why = f"{error.strerror}; free some space, the same command goes on where it stopped"
            raise CalibrationError(f"cannot write {self.path}: {why}") from None
        return _object(line)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        """Flush to disk, and let others have the file."""
        os.fsync(self._file.fileno())
        self._file.close()


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
        inner = (_difference(before.get(key), now.get(key), f"{name}.{key}".lstrip(".")) for key in {**now, **before})
        return next(filter(None, inner), "")
    was, new = (text if len(text) <= SHOWN else f"{text[:SHOWN]}..." for text in map(json.dumps, (before, now)))
    return "" if before == now else f"{name} was {was}, is now {new}"

"""Jobs, and the journal of their answers on disk: what is killed resumes where it stopped. What has no answer yet runs by Dask,
on processes of this machine or a running cluster; without it, in this process."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import os
import pickle
import re
import signal
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeAlias

import cv2

from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.result import VERSION
from calib_ros_check.outcome import plain

Answer = dict[str, Any]  # what a job found, as JSON has it: numbers, texts, lists and dictionaries; None for NaN


NAME = "results.jsonl"
BEGINNING = b'{"about":'  # of every journal
SHOWN = 60  # characters of a value in an error
Group: TypeAlias = Sequence[Any]  # jobs that share work, see Journal
RunJobs: TypeAlias = Callable[[Any], list[Answer]]  # the answers of a group, one per job, in its order; picklable
Results: TypeAlias = Generator[tuple[Group, list[Answer] | str], None, None]  # answers of groups, or how their workers ended
ADDRESS = re.compile(r"([a-z]+://)?[^/\s]+:\d{1,5}")  # a client that was given another one waits in vain
CONNECT_S, WITHOUT_WORKERS_S, LOOK_S, POLL_S = 8.0, 60.0, 1.0, 0.02
# A job that ends its worker ends no other, and workers leave Ctrl-C to this process.
LOCAL = {
    "distributed.scheduler.allowed-failures": 0,
    # Dask's own value for MALLOC_TRIM_THRESHOLD_ besides would cost a third of the CPU time: images are allocated all the time.
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), 1),
    "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
}
HANG_S = 1800.0  # for one job: checks and trials take seconds, with large models minutes
GOES_ON = "the same command goes on where it stopped"


class Journal:
    """Answers of finished jobs in the file results.jsonl of `folder`, which is made if it is missing; a context manager.

    The first line holds `about`, what the answers depend on (JSON values), and `what` wrote it; each further one a job and its
    answer. A job is a dataclass whose values JSON has; its `key` is the same for the same piece of work, and of no other. An
    existing file is gone on with if its `about` is the same, or emptied if `fresh`, but never that of another `what`. One process
    at a time has it. done: key of a job -> its answer. notes: what was wrong with the file, and what was done about it. Raises
    BadInputError for a folder that cannot be written or that another process has, for the journal of another `what`, another
    `about`, or a damaged first line.
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

    def add(self, job: Any, answer: Answer) -> None:
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


def run(
    groups: Sequence[Group],
    run_jobs: RunJobs,
    journal: Journal,
    progress: Callable[[int, int], None],
    workers: int = 1,
    scheduler: str = "",
    lost: Callable[[Any, str], list[Answer]] | None = None,
) -> None:
    """Run all jobs that `journal` has no answer for, and add each answer as it arrives. progress: told how many are done, of all.

    A group is jobs that share work; one worker does all. workers: processes of this machine; one is this process itself, unless
    `lost` is given. scheduler: of a running cluster instead, with this version and the data at the same paths. A group whose
    worker ends runs again at the end, alone. One that ends it again, or takes more than HANG_S per job, has the answers that
    `lost` gives; without it, a CalibrationError names its jobs when all others are done.

    Raises what `run_jobs` raises; BadInputError for no such scheduler; MissingDependencyError for one without Dask; and
    CalibrationError where it is lost, or no workers are left.
    """
    if workers < 1:
        raise BadInputError(f"workers must be at least 1, got {workers}")
    known, missing = set(journal.done), []
    for group in groups:
        new = list({job.key: job for job in group if job.key not in known}.values())
        known.update(job.key for job in new)
        missing += [new] if new else []
    total = len({job.key for group in groups for job in group})
    done = total - sum(map(len, missing))
    progress(done, total)
    results: Results = ((group, _by_one_thread(run_jobs, group)) for group in missing)
    if missing and (scheduler or ((workers > 1 or lost is not None) and find_spec("distributed") is not None)):
        results = _on_workers(missing, run_jobs, workers, scheduler)
    unanswered = ""
    with closing(results):
        for group, found in results:
            if isinstance(found, str) and lost is not None:
                found = lost(group, f"its {found}")
            if isinstance(found, str):
                unanswered = unanswered or f"jobs whose {found}: {', '.join(job.key for job in group)}"
                continue
            for job, answer in zip(group, found, strict=True):
                journal.add(job, answer)
            done += len(group)
            progress(done, total)
    if unanswered:
        raise CalibrationError(f"{unanswered}; out of memory? use fewer --workers, or give them more; {GOES_ON}")


def _on_workers(groups: Sequence[Group], run_jobs: RunJobs, workers: int, scheduler: str) -> Results:
    """A worker holds one group at a time: Dask blames all that a lost one held. Still it may have been another's fault, or memory
    was short: so that what ends its worker runs once more, alone."""
    waiting, died, alone, seen = deque(groups), deque[Group](), False, time.monotonic()
    running: dict[Any, tuple[Group, float]] = {}
    with _client(min(workers, len(groups)), scheduler) as client:
        from distributed import KilledWorker

        while waiting or running or died:
            if not waiting and not running:
                waiting, alone = deque([died.popleft()]), True
            threads, now = _asked(client.nthreads), time.monotonic()
            seen = now if threads else seen
            if now - seen > WITHOUT_WORKERS_S or max(threads.values(), default=1) > 1:
                wrong = "workers of several threads, where CPU times need one" if threads else "no workers"
                raise CalibrationError(f"the Dask scheduler has {wrong}; start `dask worker ADDRESS --nthreads 1`; {GOES_ON}")
            while waiting and len(running) < len(threads):
                work = partial(_answer, run_jobs, waiting[0], HANG_S * len(waiting[0]), VERSION)
                future = _asked(client.submit, lambda data: pickle.loads(data)(), pickle.dumps(work), pure=False)
                running[future] = waiting.popleft(), now
            while not any(own.done() for own in running) and time.monotonic() - now < LOOK_S:
                time.sleep(POLL_S)
            for future in [own for own in running if own.done()]:
                group, since = running.pop(future)
                try:
                    yield group, future.result()
                except KilledWorker:
                    if time.monotonic() - since > HANG_S * len(group):
                        yield group, f"worker hung for {HANG_S:g} s per job"
                    elif alone:
                        yield group, "worker ended, also alone"
                    else:
                        died.append(group)
                except CancelledError:
                    raise CalibrationError(f"the Dask scheduler is lost; {GOES_ON}") from None
                except ImportError as error:
                    needed = f"calib_ros {VERSION}, and what it needs, must be installed on all workers"
                    raise CalibrationError(f"{needed}: {error}") from None
                finally:
                    future.release()  # here, since what deletes it would swallow Ctrl-C


@contextmanager
def _client(workers: int, scheduler: str) -> Iterator[Any]:
    """Of a running cluster, or of one with so many processes of this machine, which end with the context."""
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError:
        raise MissingDependencyError("a Dask cluster needs distributed: pip install distributed") from None
    with ExitStack() as stack:
        if not scheduler:
            stack.enter_context(dask.config.set(LOCAL))
            here: dict[str, Any] = {"processes": True, "memory_limit": 0, "silence_logs": logging.CRITICAL, "host": "127.0.0.1"}
            here |= {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
            try:
                cluster = LocalCluster(n_workers=workers, threads_per_worker=1, **here)
            except RuntimeError as error:
                raise CalibrationError(f"workers end at their start: {error}; out of memory? {GOES_ON}") from None
            scheduler = stack.enter_context(cluster).scheduler_address
        try:
            if not ADDRESS.fullmatch(scheduler):
                raise ValueError(scheduler)
            client = stack.enter_context(Client(scheduler, timeout=CONNECT_S, set_as_default=False))
        except (OSError, ValueError):
            advice = "start one with `dask scheduler`, and give its address, as tcp://HOST:8786"
            raise BadInputError(f"no Dask scheduler answers at {scheduler!r}; {advice}") from None
        yield client


def _asked(call: Callable[..., Any], *given: Any, **named: Any) -> Any:
    """What the client itself does: whatever it raises, it has lost the scheduler."""
    try:
        return call(*given, **named)
    except Exception as error:
        raise CalibrationError(f"the Dask scheduler is lost; {GOES_ON}") from error


def _answer(run_jobs: RunJobs, group: Group, limit_s: float, wanted: str) -> list[Answer]:
    """On a worker, which the kernel ends after limit_s, whatever it is doing, and another takes its place. wanted: version of
    calib_ros that asks."""
    if wanted != VERSION:
        raise ImportError(f"one has calib_ros {VERSION}")
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        return _by_one_thread(run_jobs, group)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def _by_one_thread(run_jobs: RunJobs, group: Group) -> list[Answer]:
    """Of OpenCV, so that CPU time and sums do not depend on the workers. BLAS has one thread from the start."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return run_jobs(group)
    finally:
        cv2.setNumThreads(before)

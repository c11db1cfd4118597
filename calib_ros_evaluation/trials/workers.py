"""Workers on this machine: processes of their own, one group of jobs at a time each."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import connection, resource_tracker
from typing import Any, Protocol

import cv2

from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.result import VERSION
from calib_ros_evaluation.trials.journal import Answer, Job, Journal

# Does the jobs of an evaluation that are not done yet, wherever there are hands for them.
RunJobs = Callable[[Sequence[Job]], list[Answer]]  # answers of a group, one per job, in its order; must be picklable
Results = Generator[tuple[Sequence[Job], list[Answer]], None, None]


class Pool(Protocol):
    """Those who do the work."""

    def results(self, run_jobs: RunJobs, groups: Sequence[Sequence[Job]]) -> Results:
        """Every group with its answers as it is finished, in any order; each is done by one worker.

        Closing the generator stops all. What `run_jobs` raises goes up. CalibrationError if workers are lost again and again, or
        there are none.
        """
        ...


def run(
    groups: Sequence[Sequence[Job]], run_jobs: RunJobs, journal: Journal, pool: Pool, progress: Callable[[int, int], None]
) -> None:
    """Do all jobs that `journal` has no answer of, and write theirs to it as they come.

    groups: jobs that share features (the same frames and method), done together. progress: gets the number of jobs done, those of
    earlier runs too, and of all. Raises what `run_jobs` raises; answers until then are kept.
    """
    total = len({job.key for group in groups for job in group})
    missing = _missing(groups, journal)
    done = total - sum(map(len, missing))
    progress(done, total)
    if not missing:
        return
    with closing(pool.results(run_jobs, missing)) as results:
        for group, answers in results:
            for job, answer in zip(group, answers, strict=True):
                journal.add(job, answer)
            done += len(group)
            progress(done, total)


def _missing(groups: Sequence[Sequence[Job]], journal: Journal) -> list[list[Job]]:
    """Groups of the jobs without an answer, each job once."""
    seen = set(journal.done)
    missing = []
    for group in groups:
        new = []
        for job in group:
            if job.key not in seen:
                seen.add(job.key)
                new.append(job)
        if new:
            missing.append(new)
    return missing


Group = Sequence[Job]
Reply = tuple[list[Answer], tuple[Exception, str] | None]  # answers, or what was raised and its traceback
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
EXIT_S = 5.0  # a process that has closed its pipe is gone after
ADVICE = "out of memory? use fewer --workers; the same command goes on where it stopped"


class LocalPool:
    """`workers` processes; one means this process itself. start: called first in each of them; must be picklable.

    A group that a worker dies of (out of memory, a crash in a library) is done once more after all others, alone on the machine;
    CalibrationError that names its jobs if its worker dies again. All workers end at once when the generator is closed, on Ctrl-C
    and when this process is killed. A pipe for each worker, because concurrent.futures gives up every group in flight when one
    worker dies, does not know which of them it was, and leaves its workers behind when this process is killed.
    """

    def __init__(self, workers: int, start: Callable[[], None] | None = None):
        if workers < 1:
            raise BadInputError(f"workers must be at least 1, got {workers}")
        self.workers, self.start = workers, start

    def results(self, run_jobs: RunJobs, groups: Sequence[Group]) -> Results:
        """As Pool has it."""
        if self.workers == 1:
            yield from self._here(run_jobs, groups)
            return
        lost: list[tuple[Group, str]] = []
        yield from self._spread(run_jobs, groups, lost)
        for group, _ in lost:
            again: list[tuple[Group, str]] = []
            yield from self._spread(run_jobs, [group], again)
            for _, how in again:
                raise CalibrationError(f"the worker of these jobs ended twice, {how}: {names(group)}; {ADVICE}")

    def _here(self, run_jobs: RunJobs, groups: Sequence[Group]) -> Results:
        with one_thread():
            if self.start:
                self.start()
            for group in groups:
                yield group, run_jobs(group)

    def _spread(self, run_jobs: RunJobs, groups: Sequence[Group], lost: list[tuple[Group, str]]) -> Results:
        """Groups with their answers; those whose worker died go to `lost`, with how it ended."""
        waiting = deque(groups)
        workers: dict[connection.Connection, _Worker] = {}
        try:
            for _ in range(min(self.workers, len(groups))):
                self._hire(run_jobs, workers)
            while workers:
                for pipe in connection.wait(list(workers)):
                    assert isinstance(pipe, connection.Connection)
                    worker, group = workers[pipe], workers[pipe].group
                    reply = worker.reply()
                    if reply is None:
                        how = workers.pop(pipe).stop(EXIT_S)
                        if group is None:
                            raise CalibrationError(f"a worker process ended at its start, {how}; {ADVICE}")
                        lost.append((group, how))
                        if len(workers) < len(waiting):
                            self._hire(run_jobs, workers)
                        continue
                    answers, failure = reply
                    if failure:
                        raise failure[0] from RuntimeError(f"in a worker:\n{failure[1]}")
                    if waiting:
                        worker.give(waiting.popleft())
                    else:
                        workers.pop(pipe).stop()
                    if group is not None:
                        yield group, answers
        finally:
            for worker in workers.values():
                worker.stop()

    def _hire(self, run_jobs: RunJobs, workers: dict[connection.Connection, _Worker]) -> None:
        """Ctrl-C is for this process only: the new one inherits that it is blocked, until it ignores it itself."""
        context = multiprocessing.get_context("spawn")
        ours, its = context.Pipe()
        process = context.Process(target=_work, args=(its, run_jobs, self.start), daemon=True)
        resource_tracker.ensure_running()  # or the first start does it, and lets Ctrl-C through
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            with _environment(ONE_THREAD):
                process.start()
            workers[ours] = _Worker(process, ours)
        finally:
            its.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


@dataclass(eq=False)
class _Worker:
    """A worker as its owner sees it. group: what it is doing, None until it is ready."""

    process: multiprocessing.process.BaseProcess
    pipe: connection.Connection
    group: Group | None = None

    def give(self, group: Group) -> None:
        self.group = group
        with contextlib.suppress(OSError):  # dead already: the reply says so
            self.pipe.send(group)

    def reply(self) -> Reply | None:
        """None if it died."""
        try:
            answer: Reply = self.pipe.recv()
        except (EOFError, OSError):
            return None
        return answer

    def stop(self, grace_s: float = 0.0) -> str:
        """Ends it, it holds nothing that would be lost. grace_s: to end by itself. How it ended, for people."""
        self.process.join(grace_s)
        self.process.kill()
        self.process.join()
        self.pipe.close()
        code = self.process.exitcode or 0
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"


def _work(pipe: connection.Connection, run_jobs: RunJobs, start: Callable[[], None] | None) -> None:
    """All that a worker process does: a reply when it is ready, and one for every group."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    _reply(pipe, start or (lambda: None))
    while True:
        try:
            group = pipe.recv()
        except EOFError:
            return
        _reply(pipe, partial(run_jobs, group))


def _reply(pipe: connection.Connection, act: Callable[[], list[Answer] | None]) -> None:
    try:
        pipe.send((act() or [], None))
    except Exception as error:
        pipe.send(([], (_portable(error), traceback.format_exc())))


def _portable(error: Exception) -> Exception:
    """The error itself if it survives the way to another process, else one with its text."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _end_with_parent() -> None:
    """Killed, the parent can end nobody; a worker in the middle of a group would not notice for long."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV with one thread, BLAS too where threadpoolctl is installed (scikit-learn brings it): CPU time is then that of the
    algorithm, and sums come out the same however many workers there are."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        limits = importlib.import_module("threadpoolctl").threadpool_limits(1)
    except ImportError:
        limits = contextlib.nullcontext()
    try:
        with limits:
            yield
    finally:
        cv2.setNumThreads(before)


@contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def names(group: Group, most: int = 3) -> str:
    """Keys of the first jobs of a group, for people."""
    more = f" and {len(group) - most} more" if len(group) > most else ""
    return ", ".join(job.key for job in group[:most]) + more


# Workers of a Dask cluster, which may be on other machines.
CONNECT_S = 8.0
WAIT_FOR_WORKERS_S = 20.0
IN_FLIGHT = 2  # groups per worker: the next one is there when one is finished, and a worker that is lost has few to hand on
RETRIES = 2  # of a group whose perform raises: its worker may not reach the data, or have no memory left
SAME = f"calib_ros {VERSION} must be installed on the scheduler and all workers"
GOES_ON = "the same command goes on where it stopped"


class ClusterPool:
    """The workers of the Dask scheduler at `address` (tcp://host:8786), as many as there are at any moment.

    A group of a worker that is lost goes to another. Needs calib_ros of this version on the scheduler and the workers, workers
    with one thread each (CPU times of two threads cannot be told apart), and the data at the same paths there. Raises
    MissingDependencyError without distributed, BadInputError if nobody answers at the address, CalibrationError if there are no
    workers within WAIT_FOR_WORKERS_S, they do not fit, one group ends several of them, or the scheduler is lost.
    """

    def __init__(self, address: str, wait_s: float = WAIT_FOR_WORKERS_S):
        self.address, self.wait_s = address, wait_s

    def results(self, run_jobs: RunJobs, groups: Sequence[Sequence[Job]]) -> Results:
        """As Pool has it."""
        client = self._client()
        try:
            self._check(client)
            yield from self._spread(client, run_jobs, groups)
        finally:
            client.close(timeout=CONNECT_S)  # the scheduler forgets what it has not done yet

    def _client(self) -> Any:
        try:
            return _library().Client(self.address, timeout=CONNECT_S, set_as_default=False)
        except ValueError as error:
            raise BadInputError(f"{self.address!r} is no address of a Dask scheduler ({error}); tcp://HOST:8786 is one") from None
        except OSError:
            raise BadInputError(
                f"no Dask scheduler answers at {self.address}; start it with `dask scheduler`, or correct the address"
            ) from None

    def _check(self, client: Any) -> None:
        try:
            client.wait_for_workers(1, timeout=self.wait_s)
        except (TimeoutError, asyncio.TimeoutError):  # two kinds until Python 3.10
            raise CalibrationError(
                f"the Dask scheduler at {self.address} has no workers; start some with `dask worker {self.address} --nthreads 1`"
            ) from None
        try:
            versions = {"the scheduler": client.run_on_scheduler(version)}
        except Exception as error:
            versions = {"the scheduler": error}
        with self._connected():
            versions |= client.run(version, on_error="return")
            threads_of = client.nthreads()
        for where, found in versions.items():
            if found != VERSION:
                raise CalibrationError(f"{SAME}; {where} has {'none: ' if isinstance(found, Exception) else ''}{found}")
        for where, threads in threads_of.items():
            if threads > 1:
                raise CalibrationError(
                    f"the worker {where} has {threads} threads, CPU times need one; start it with "
                    f"`dask worker {self.address} --nworkers {threads} --nthreads 1`"
                )

    def _spread(self, client: Any, run_jobs: RunJobs, groups: Sequence[Sequence[Job]]) -> Results:
        waiting, finished = deque(groups), _library().as_completed(loop=client.loop)
        running: dict[Any, Sequence[Job]] = {}
        while waiting or running:
            with self._connected():
                room = IN_FLIGHT * max(len(client.nthreads()), 1) - len(running)
            for _ in range(min(room, len(waiting))):
                group = waiting.popleft()
                work = pickle.dumps((run_jobs, group))
                with self._connected():
                    future = client.submit(answer, work, VERSION, pure=False, retries=RETRIES)
                running[future] = group
                finished.add(future)
            future = next(finished)
            group = running.pop(future)
            yield group, self._answers(future, group)

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """For what the client itself does: whatever it raises, it has lost the scheduler."""
        try:
            yield
        except Exception as error:
            raise self._lost() from error

    def _lost(self) -> CalibrationError:
        return CalibrationError(f"the Dask scheduler at {self.address} is lost; {GOES_ON}")

    def _answers(self, future: Any, group: Sequence[Job]) -> list[Answer]:
        try:
            answers: list[Answer] = future.result()
        except CancelledError:
            raise self._lost() from None
        except _library().KilledWorker:
            raise CalibrationError(
                f"several workers ended with these jobs: {names(group)}; out of memory? give them more; {GOES_ON}"
            ) from None
        except ImportError as error:
            raise CalibrationError(f"{SAME}, with what it needs: {error}") from None
        return answers


def version() -> str:
    """Of calib_ros, where this runs."""
    return VERSION


def answer(work: bytes, wanted: str) -> list[Answer]:
    """Perform a group on a worker. work: pickled (perform, group). wanted: version of calib_ros that the evaluation has; the
    worker may have come later than the check."""
    if version() != wanted:
        raise CalibrationError(f"a worker has calib_ros {version()}, the evaluation {wanted}; {SAME}")
    run_jobs, group = pickle.loads(work)
    with one_thread():
        answers: list[Answer] = run_jobs(group)
    return answers


def _library() -> Any:
    try:
        import distributed
    except ImportError:
        raise MissingDependencyError("a Dask cluster needs distributed: pip install distributed") from None
    return distributed

"""Runs the jobs of an evaluation that have no answer yet, in processes of this machine or on a Dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from multiprocessing import connection, resource_tracker
from typing import Any, Protocol

import cv2

from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.result import VERSION
from calib_ros_evaluation.trials.journal import Answer, Job, Journal

Group = Sequence[Job]  # jobs that share features; one worker does all of them
RunJobs = Callable[[Group], list[Answer]]  # the answers of a group, one per job, in its order; picklable
Results = Generator[tuple[Group, list[Answer]], None, None]

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
OUT_OF_MEMORY = "out of memory? use fewer --workers; the same command goes on where it stopped"

CONNECT_S = 8.0
WAIT_FOR_WORKERS_S = 20.0
IN_FLIGHT = 2  # groups per Dask worker: the next one is there when one is finished, and a lost worker returns few
RETRIES = 2  # of a group that raises: its worker may not reach the data, or have no memory left
SAME_VERSION = f"calib_ros {VERSION} must be installed on the scheduler and all workers"
GOES_ON = "the same command goes on where it stopped"


class Pool(Protocol):
    """Workers: processes of this machine (`LocalPool`), or of a cluster (`ClusterPool`)."""

    def results(self, run_jobs: RunJobs, groups: Sequence[Group]) -> Results:
        """Every group with its answers as it is finished, in any order.

        Closing the generator stops all workers. Raises what `run_jobs` raises, and CalibrationError if workers are lost again and
        again, or there are none.
        """
        ...


def run(groups: Sequence[Group], run_jobs: RunJobs, journal: Journal, pool: Pool, progress: Callable[[int, int], None]) -> None:
    """Run all jobs that `journal` has no answer for, and add each answer as it arrives.

    progress: called with the number of finished jobs, those of earlier runs included, and of all. Raises what `run_jobs` raises;
    answers until then are kept.
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


def _missing(groups: Sequence[Group], journal: Journal) -> list[list[Job]]:
    """Groups of the jobs without an answer, each job once."""
    known = set(journal.done)
    missing = []
    for group in groups:
        new = list({job.key: job for job in group if job.key not in known}.values())
        known.update(job.key for job in new)
        if new:
            missing.append(new)
    return missing


class LocalPool:
    """`workers` processes of this machine by concurrent.futures; one means this process itself.

    When a worker dies (out of memory, a crash in a library), a new pool takes the groups that had not begun. Those in progress
    run again at the end, each alone on the machine, since the pool cannot say which of them it was; CalibrationError names the
    one whose worker dies again. All workers end when the generator is closed, on Ctrl-C, and when this process is killed.
    """

    def __init__(self, workers: int):
        if workers < 1:
            raise BadInputError(f"workers must be at least 1, got {workers}")
        self.workers = workers

    def results(self, run_jobs: RunJobs, groups: Sequence[Group]) -> Results:
        """See Pool."""
        if self.workers == 1:
            with one_thread():
                for group in groups:
                    yield group, run_jobs(group)
            return
        waiting, lost, twice = deque(groups), list[Group](), list[tuple[Group, str]]()
        while waiting:
            in_progress, _ = yield from _until_crash(run_jobs, waiting, self.workers)
            lost += in_progress
        for group in lost:
            in_progress, how = yield from _until_crash(run_jobs, deque([group]), 1)
            twice += [(again, how) for again in in_progress]
        for group, how in twice:
            raise CalibrationError(f"the worker of these jobs ended twice, {how}: {names(group)}; {OUT_OF_MEMORY}")


def _until_crash(
    run_jobs: RunJobs, waiting: deque[Group], workers: int
) -> Generator[tuple[Group, list[Answer]], None, tuple[list[Group], str]]:
    """Takes groups from `waiting` and yields their answers, until none is left or a worker dies.

    Returns the groups that were in progress then, and how the worker ended.
    """
    running: dict[Future[list[Answer]], Group] = {}
    lost: list[Group] = []
    with _Processes(min(workers, len(waiting))) as processes:
        try:
            processes.submit(int).result()
        except BrokenProcessPool:
            raise CalibrationError(f"a worker process ended at its start, {processes.how_ended()}; {OUT_OF_MEMORY}") from None
        while running or (waiting and not lost):
            while waiting and len(running) < workers and not lost:
                group = waiting.popleft()
                try:
                    running[processes.submit(_run_portably, run_jobs, group)] = group
                except BrokenProcessPool:
                    lost.append(group)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                group = running.pop(future)
                try:
                    answers = future.result()
                except BrokenProcessPool:
                    lost.append(group)
                else:
                    yield group, answers
        return lost, processes.how_ended() if lost else ""


class _Processes:
    """A ProcessPoolExecutor whose processes end at once with the context, whatever they are doing."""

    def __init__(self, workers: int):
        self._executor = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _prepare_process)
        self._processes: list[multiprocessing.process.BaseProcess] = []

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Processes start here, when they are needed: with one thread each, and with Ctrl-C blocked until they ignore it."""
        before = multiprocessing.active_children()
        resource_tracker.ensure_running()  # or the first start does it, and lets Ctrl-C through
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            with _environment(ONE_THREAD):
                return self._executor.submit(function, *arguments)
        finally:
            self._processes += [process for process in multiprocessing.active_children() if process not in before]
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)

    def how_ended(self) -> str:
        """For people, once a worker has died: the executor terminates all others."""
        self._executor.shutdown()
        codes = [process.exitcode or 0 for process in self._processes]
        code = min(codes, key=lambda code: (code == 0, code == -signal.SIGTERM))
        return f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit status {code}"

    def __enter__(self) -> _Processes:
        return self

    def __exit__(self, *error: object) -> None:
        for process in self._processes:
            process.kill()  # it holds nothing that would be lost
        self._executor.shutdown(cancel_futures=True)


def _prepare_process() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)


def _end_with_parent() -> None:
    """A killed parent cannot end its workers, and one in the middle of a group would not notice for long."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _run_portably(run_jobs: RunJobs, group: Group) -> list[Answer]:
    """An error that does not survive the way to another process would count as the death of a worker: its text is raised."""
    try:
        return run_jobs(group)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            raise RuntimeError(f"{type(error).__name__}: {error}").with_traceback(error.__traceback__) from None
        raise


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV with one thread, BLAS too where threadpoolctl is installed: CPU time is then that of the
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


class ClusterPool:
    """The workers of the Dask scheduler at `address` (tcp://host:8786), as many as there are at any moment.

    A group of a worker that is lost goes to another. Needs calib_ros of this version on the scheduler and the workers, workers
    with one thread each (CPU times of two threads cannot be told apart), and the data at the same paths there. Raises
    MissingDependencyError without distributed, BadInputError if nobody answers at the address, CalibrationError if there are no
    workers within WAIT_FOR_WORKERS_S, they do not fit, one group ends several of them, or the scheduler is lost.
    """

    def __init__(self, address: str, wait_s: float = WAIT_FOR_WORKERS_S):
        self.address, self.wait_s = address, wait_s

    def results(self, run_jobs: RunJobs, groups: Sequence[Group]) -> Results:
        """See Pool."""
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
                raise CalibrationError(f"{SAME_VERSION}; {where} has {'none: ' if isinstance(found, Exception) else ''}{found}")
        for where, threads in threads_of.items():
            if threads > 1:
                raise CalibrationError(
                    f"the worker {where} has {threads} threads, CPU times need one; start it with "
                    f"`dask worker {self.address} --nworkers {threads} --nthreads 1`"
                )

    def _spread(self, client: Any, run_jobs: RunJobs, groups: Sequence[Group]) -> Results:
        waiting, finished = deque(groups), _library().as_completed(loop=client.loop)
        running: dict[Any, Group] = {}
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

    def _answers(self, future: Any, group: Group) -> list[Answer]:
        try:
            answers: list[Answer] = future.result()
        except CancelledError:
            raise self._lost() from None
        except _library().KilledWorker:
            raise CalibrationError(
                f"several workers ended with these jobs: {names(group)}; out of memory? give them more; {GOES_ON}"
            ) from None
        except ImportError as error:
            raise CalibrationError(f"{SAME_VERSION}, with what it needs: {error}") from None
        return answers


def version() -> str:
    """Of calib_ros, where this runs."""
    return VERSION


def answer(work: bytes, wanted: str) -> list[Answer]:
    """Run a group on a Dask worker. work: pickled (run_jobs, group). wanted: version of calib_ros of the evaluation; the worker
    may have joined after the check."""
    if version() != wanted:
        raise CalibrationError(f"a worker has calib_ros {version()}, the evaluation {wanted}; {SAME_VERSION}")
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

"""Workers of a Dask cluster."""

from __future__ import annotations

import asyncio
import pickle
import re
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from typing import Any

from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.result import VERSION
from calib_ros_check.jobs.journal import Answer
from calib_ros_check.jobs.pool import GOES_ON, Ended, J, Lost, Results, RunJobs, all_answers, one_thread

ADDRESS = re.compile(r"(inproc://.+)|([a-z]+://)?[^/\s]+:\d{1,5}")
CONNECT_S = 8.0
WAIT_FOR_WORKERS_S = 20.0
WITHOUT_WORKERS, POLL_S = 4.0, 0.02  # times as long as for the first one: one that died is started again meanwhile
IN_FLIGHT = 2  # groups per Dask worker: the next one is there when one is finished, and a lost worker returns few
RETRIES = 2  # of a group that raises: its worker may not reach the data, or have no memory left
SAME_VERSION = f"calib_ros {VERSION} must be installed on the scheduler and all workers"


class ClusterPool:
    """The workers of the Dask scheduler at `address` (tcp://host:8786), as many as there are at any moment.

    A group of a worker that is lost goes to another. Needs calib_ros of this version on the scheduler and the workers, workers
    with one thread each (CPU times of two threads cannot be told apart), and the data at the same paths there. Raises
    MissingDependencyError without distributed, BadInputError if nobody answers at the address, CalibrationError if there are no
    workers within WAIT_FOR_WORKERS_S or no more, they do not fit, one group ends several of them, or the scheduler is lost.
    """

    def __init__(self, address: str, wait_s: float = WAIT_FOR_WORKERS_S):
        self.address, self.wait_s = address, wait_s

    def results(self, run_jobs: RunJobs[J], groups: Sequence[Sequence[J]], lost: Lost[J] | None = None) -> Results[J]:
        """See Pool."""
        client = self._client()
        try:
            self._check(client)
            yield from all_answers(partial(self._spread, client, run_jobs), groups, lost)
        finally:
            client.close(timeout=CONNECT_S)  # the scheduler forgets what it has not done yet

    def _client(self) -> Any:
        if not ADDRESS.fullmatch(self.address):  # a client that was given such a one waits in vain when it is deleted
            raise BadInputError(f"{self.address!r} is no address of a Dask scheduler; tcp://HOST:8786 is one")
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

    def _spread(self, client: Any, run_jobs: RunJobs[J], groups: Sequence[Sequence[J]], ended: Ended[J]) -> Results[J]:
        """Answers of all groups but those whose workers end, which are added to `ended`; Dask blames all that a lost worker held,
        not only what ended it."""
        waiting, finished = deque(groups), _library().as_completed(loop=client.loop)
        running: dict[Any, Sequence[J]] = {}
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
            self._wait(client, finished)
            future = next(finished)
            group = running.pop(future)
            try:
                answers: list[Answer] = future.result()
            except _library().KilledWorker:
                ended.append((group, "workers ended several times"))
            except CancelledError:
                raise self._lost() from None
            except ImportError as error:
                raise CalibrationError(f"{SAME_VERSION}, with what it needs: {error}") from None
            else:
                yield group, answers

    def _wait(self, client: Any, finished: Any) -> None:
        """Until a group is done. CalibrationError where no worker has been left for a long time."""
        last_seen = time.monotonic()
        while not finished.has_ready():
            time.sleep(POLL_S)
            if time.monotonic() - last_seen > self.wait_s:
                with self._connected():
                    if client.nthreads():
                        last_seen = time.monotonic()
            if time.monotonic() - last_seen > WITHOUT_WORKERS * self.wait_s:
                raise CalibrationError(f"the Dask scheduler at {self.address} has no workers any more; start some; {GOES_ON}")

    @contextmanager
    def _connected(self) -> Iterator[None]:
        """For what the client itself does: whatever it raises, it has lost the scheduler."""
        try:
            yield
        except Exception as error:
            raise self._lost() from error

    def _lost(self) -> CalibrationError:
        return CalibrationError(f"the Dask scheduler at {self.address} is lost; {GOES_ON}")


def version() -> str:
    """Of calib_ros, where this runs."""
    return VERSION


def answer(work: bytes, wanted: str) -> list[Answer]:
    """Run a group on a Dask worker. work: pickled (run_jobs, group). wanted: version of calib_ros that asks; the worker
    may have joined after the check."""
    if version() != wanted:
        raise CalibrationError(f"a worker has calib_ros {version()}, this machine {wanted}; {SAME_VERSION}")
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

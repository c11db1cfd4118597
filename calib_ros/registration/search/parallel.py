"""Independent parts of a computation on several threads: NumPy, OpenCV and kernel.c release the interpreter lock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import TypeVar

Item = TypeVar("Item")
Out = TypeVar("Out")

_of_thread = threading.local()


def cpu_time() -> float:
    """CPU time of this thread in s, and of the Workers that it has closed: their work is this thread's."""
    return time.thread_time() + float(getattr(_of_thread, "workers_s", 0.0))


class Workers:
    """A pool of threads for calls that do not depend on each other, to be used as a context manager. With one thread there is no
    pool: calls are made by the caller's own thread, each when its result is asked for."""

    def __init__(self, threads: int = 1) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="calib_search") if threads > 1 else None
        self._seconds: list[float] = []  # CPU time of every call that has ended

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        """Calls that have not begun are dropped, those that have are waited for."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            _of_thread.workers_s = getattr(_of_thread, "workers_s", 0.0) + sum(self._seconds)

    def map(self, run: Callable[[Item], Out], items: Iterable[Item]) -> Iterator[Out]:
        """The results in the order of the items. An exception of a call is raised in its turn."""
        if self._pool is None:
            return map(run, items)

        def timed(item: Item) -> Out:
            began = time.thread_time()
            try:
                return run(item)
            finally:
                self._seconds.append(time.thread_time() - began)

        return self._pool.map(timed, items)


SERIAL = Workers()

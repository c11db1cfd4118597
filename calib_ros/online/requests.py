"""Requests for an estimate: who shares a run, hears of its progress, and may end it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass

from calib_ros.errors import CalibrationError
from calib_ros.online.worker import Cancelled
from calib_ros.registration.progress import Callback
from calib_ros.result import Extrinsic


@dataclass(frozen=True, eq=False)
class _Request:
    future: Future[Extrinsic]
    progress: Callback | None

    @property
    def waits(self) -> bool:
        return not self.future.cancelled()


class Requests:
    """Requests that wait for a run, and those that the run under way answers. There is one run at a time. Thread-safe.

    A request is a future, whose cancel() ends it at once; a run that was asked for ends when nobody waits for it any more.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: list[_Request] = []
        self._answered: list[_Request] = []  # by the run under way
        self._asked_for = False  # the run under way was
        self._keyframes: int | None = None  # that the run under way is over; None = no request may join it
        self._refusal = ""

    @property
    def refused(self) -> bool:
        """True between refuse() and accept()."""
        return bool(self._refusal)

    def add(self, keyframes: int, progress: Callback | None = None) -> tuple[Future[Extrinsic], bool]:
        """A new request over so many keyframes so far, and whether it needs a run of its own, because it joins none.

        progress: called on the thread of the run with its stage and share done, from when the request joins it; must not raise.
        """
        request = _Request(Future(), progress)
        with self._lock:
            if self._refusal:
                request.future.set_exception(CalibrationError(self._refusal))
                return request.future, False
            joins = self._keyframes == keyframes
            (self._answered if joins else self._waiting).append(request)
        return request.future, not joins

    def begin(self, keyframes: int) -> bool:
        """A run begins, over so many keyframes so far; True if it was asked for, and answers the requests that wait."""
        with self._lock:
            self._answered, self._waiting = [request for request in self._waiting if request.waits], []
            self._asked_for = bool(self._answered)
            self._keyframes = keyframes if self._asked_for else None
            return self._asked_for

    def close(self) -> None:
        """No request joins the run under way from now on: it would give another result than a run of its own."""
        with self._lock:
            self._keyframes = None

    def report(self, stage: str, share: float) -> None:
        """Progress of the run under way. Raises Cancelled if nobody waits for it any more, or requests are refused."""
        with self._lock:
            self._answered = [request for request in self._answered if request.waits]
            if self._refusal or (self._asked_for and not self._answered):
                self._keyframes = None  # under the same lock: who asks from now on gets a run of its own
                raise Cancelled
            listeners = [request.progress for request in self._answered if request.progress is not None]
        for listener in listeners:
            listener(stage, share)

    def answer(self, extrinsic: Extrinsic) -> None:
        """The run under way is done."""
        _finish(self._take_answered(), lambda future: future.set_result(extrinsic))

    def fail(self, error: BaseException) -> None:
        """The run under way ended without a result."""
        _finish(self._take_answered(), lambda future: future.set_exception(error))

    def refuse(self, reason: str) -> None:
        """Fail all requests with a CalibrationError, new ones too, and end the run under way, asked for or not."""
        with self._lock:
            self._refusal = reason
            waiting, self._waiting = self._waiting, []
        _finish([*self._take_answered(), *waiting], lambda future: future.set_exception(CalibrationError(reason)))

    def accept(self) -> None:
        """Take requests again."""
        with self._lock:
            self._refusal = ""

    def _take_answered(self) -> list[_Request]:
        with self._lock:
            self._keyframes = None
            taken, self._answered = self._answered, []
        return taken


def _finish(requests: Sequence[_Request], how: Callable[[Future[Extrinsic]], None]) -> None:
    for request in requests:
        if request.future.set_running_or_notify_cancel():  # from here on it cannot be cancelled
            how(request.future)

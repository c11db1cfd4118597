"""What the pipeline says to its owner, each thing once and in the right order."""

from __future__ import annotations

import threading
from collections.abc import Callable

from calib_ros.online.extrinsic import Extrinsic
from calib_ros.online.hooks import Hooks
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.result import Result


class Teller:
    """Publishes through the hooks from any thread: what is published last is what is in force.

    in_force: gives the recalibrator in use, None before the first. stamp: of the newest data, ns; to be set by the pipeline.
    """

    def __init__(self, hooks: Hooks, in_force: Callable[[], Recalibrator | None]) -> None:
        self.stamp = 0
        self._hooks, self._in_force = hooks, in_force
        self._lock = threading.Lock()
        self._last: Result | None = None
        self._said: set[str] = set()

    def extrinsic(self, recalibrator: Recalibrator, again: bool = False) -> None:
        """The extrinsic in force, if it or its status is another than told last; nothing of a recalibrator that was replaced.

        What the monitor says of one that is right goes to the diagnostics alone.
        """
        with self._lock:
            extrinsic = recalibrator.current
            if recalibrator is self._in_force() and (again or extrinsic.result is not self._last):
                self._last = extrinsic.result
                self._hooks.on_extrinsic(extrinsic, self.stamp)

    def to(self, listener: Callable[[Extrinsic, int], None]) -> None:
        """Call `listener` with the extrinsic in force and its stamp, if there is one; nothing newer is told meanwhile."""
        with self._lock:
            recalibrator = self._in_force()
            if recalibrator is not None:
                listener(recalibrator.current, self.stamp)

    def what_is_missing(self, recalibrator: Recalibrator) -> None:
        """What the estimates have to do without, a line each, once."""
        newest, lines = recalibrator.newest(), [recalibrator.motion.missing]
        if newest is not None and not newest.has_reflectivity:
            lines.append("the cloud has no intensity: reflectivity edges are off, everything else works")
        for line in lines:
            if line and line not in self._said:
                self._said.add(line)
                self._hooks.on_error(line)

"""What is known of a running node over the last hour, in bounded memory; no ROS in it.

Times are those of the viewer's clock, s since the epoch. To be used with a lock, or on one thread.
"""

from __future__ import annotations

import math
import re
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.result import BLINDED, CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, SUSPECT, TENTATIVE, Result
from calib_ros_check.rig.shown import BAD, DOUBTFUL, GOOD, LEVELS, NEUTRAL

Pair = tuple[str, str]  # camera, LiDAR
HOUR = 3600.0
MAX_EVENTS = 400
NUMBER = re.compile(r"\d[\d.]*(e[-+]?\d+)?")
SILENT_S = 4.0  # the node publishes once a second, and one message may be late
WORDS = {
    INITIAL: "Nothing estimated yet: this is the extrinsic it started from. It collects keyframes.",
    TENTATIVE: "A first estimate was accepted. Further keyframes have to confirm it; do not use it yet.",
    CONVERGED: "The extrinsic is known, and every check of it passed.",
    REFUSED: "The last estimate failed a check and was not used; the last good extrinsic stays.",
    INSUFFICIENT: "The scenes show too little, or one direction cannot be seen: this is the best there is.",
    SUSPECT: "The newest keyframes do not fit the extrinsic. It is being tested whether the sensors have moved.",
    MOVED: "The sensors have moved. The extrinsic is searched anew; do not use it.",
    BLINDED: "A sensor shows nothing: covered lens, frozen image or empty cloud. The extrinsic is not checked any more.",
}
UNCHECKED = "The extrinsic was known when data last came; nothing checks it now."


@dataclass(frozen=True)
class Event:
    """Something that happened. count: how often in a row; `at` is the newest time. level: good, doubtful, bad or neutral."""

    at: float
    text: str
    level: str = NEUTRAL
    count: int = 1


@dataclass(frozen=True, eq=False)
class NodeState:
    """The newest of ~/extrinsic. data_age_s: NaN = no data yet. advice: what it lacks, in a line."""

    result: Result
    drift: float = 0.0
    usable: bool = False
    data_age_s: float = math.nan
    advice: str = ""

    @property
    def level(self) -> str:
        """How good it is."""
        return LEVELS.get(self.result.status, BAD)

    @property
    def words(self) -> str:
        """The status in a sentence."""
        if self.result.status == CONVERGED and not self.usable:
            return UNCHECKED
        return WORDS.get(self.result.status, f"The node says: {self.result.status}.")


@dataclass
class Diagnosis:
    """The newest of /diagnostics. level: 0 OK, 1 WARN, 2 ERROR, 3 STALE."""

    level: int = 0
    message: str = ""
    values: Mapping[str, str] = field(default_factory=dict)
    check: str = "never run"

    def number(self, name: str) -> float:
        """A value as a number, NaN where it is none; of "0.29 of 0.5" the first."""
        try:
            return float(self.values.get(name, "").split(" ")[0])
        except ValueError:
            return math.nan


class Ring:
    """The newest `span_s` of rows of numbers, at most one row in span_s / capacity seconds: the last one of each such step.

    The newest row is always there. A row from before it begins the series anew.
    """

    def __init__(self, width: int, span_s: float = 3600.0, capacity: int = 1800) -> None:
        self.step_s, self._span_s = span_s / capacity, span_s
        self._rows: deque[Matrix] = deque(maxlen=capacity)  # time first
        self._empty = np.empty((0, width + 1))

    def add(self, time_s: float, values: ArrayLike) -> None:
        """A row (width,); it takes the place of the row before in the same step."""
        if self._rows and time_s < self._rows[-1][0]:
            self._rows.clear()
        if len(self._rows) > 1 and time_s // self.step_s == self._rows[-1][0] // self.step_s:
            self._rows.pop()
        self._rows.append(np.hstack([time_s, np.broadcast_to(values, self._empty.shape[1] - 1)]))

    def rows(self, since_s: float = -np.inf, most: int = 0) -> Matrix:
        """(n, 1 + width): times and values not older than since_s nor than the span, oldest first.

        most: at most so many (0 = all), evenly, with the newest one; every gap stays.
        """
        if not self._rows:
            return self._empty
        rows = np.array(self._rows)
        rows = rows[rows[:, 0] >= max(since_s, rows[-1, 0] - self._span_s)]
        if most and len(rows) > most:
            chosen = np.linspace(0, len(rows) - 1, most).round().astype(int)
            gaps = np.flatnonzero(np.isnan(rows[:, 1:]).all(axis=1))
            rows = rows[np.union1d(chosen, gaps)]
        return np.asarray(rows)


class LiveHistory:
    """State, series and events of one node. heard: when last, None = not yet. gone: it was, but is no more, as of the last tick.

    states: T row by row (12 numbers), six standard deviations, drift. measures: p-value, images, clouds and pairs per s, share of
    a core.
    """

    def __init__(self, started: float | None = None) -> None:
        self.started = time.time() if started is None else started
        self.state: NodeState | None = None
        self.diagnosis = Diagnosis()
        self.heard: float | None = None
        self.states, self.measures = Ring(19), Ring(5)
        self.events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self.spans: deque[tuple[float, str]] = deque(maxlen=MAX_EVENTS)  # from when a status holds
        self._first: Matrix | None = None
        self._accepted = self._images = 0.0
        self._last_error = ""
        self.gone = False
        self._back = -math.inf  # when it was heard again
        self.restarted = -math.inf  # since when another process of the node is heard

    # ---- what comes in ------------------------------------------------------------------------------------------------

    def add_extrinsic(self, at: float, state: NodeState) -> None:
        """A message of ~/extrinsic."""
        self._hear(at)
        result, before = state.result, self.state
        if before is None or before.result.status != result.status:
            self._begin(at, result.status)
            self.note(at, f"{result.status}{f': {result.reason}' if result.reason else ''}", state.level)
        elif before.usable != state.usable:
            self.note(at, "usable again" if state.usable else f"not usable: {result.reason or result.status}", state.level)
        if self._first is None:
            self._first = result.T_camera_lidar
        sigma = np.full(6, np.nan) if result.covariance is None else np.sqrt(np.maximum(np.diag(result.covariance), 0))
        self.states.add(at, [*result.T_camera_lidar[:3].ravel(), *sigma, state.drift])
        self.state = state

    def add_diagnosis(self, at: float, diagnosis: Diagnosis) -> None:
        """A message of /diagnostics."""
        self._hear(at)
        self.diagnosis = diagnosis
        images, accepted = diagnosis.number("images"), diagnosis.number("estimates accepted")
        if images < self._images:
            self.note(at, "the node was started anew: its counters begin at zero", NEUTRAL)
            # One that was gone is another since it is heard again, unless that restart was known already.
            self.restarted = self._back if self._back > self.restarted else at
            self._accepted = 0
        if accepted > self._accepted:
            self.note(at, f"estimate accepted, drift {diagnosis.values.get('drift', '?')}", GOOD)
        self._images = 0.0 if math.isnan(images) else images
        self._accepted = self._accepted if math.isnan(accepted) else accepted
        error = diagnosis.values.get("last error", "")
        # What begins so is the status with its reason, which has an event already.
        if error and error != self._last_error and not error.startswith("extrinsic "):
            self.note(at, error, DOUBTFUL)
        self._last_error = error
        names = ("monitor p-value", "images per s", "clouds per s", "pairs per s", "CPU, share of a core")
        self.measures.add(at, [diagnosis.number(name) for name in names])

    def note(self, at: float, text: str, level: str = NEUTRAL) -> None:
        """An event; the same one again, with whatever numbers, only counts up."""
        last = self.events[-1] if self.events else None
        if last is not None and NUMBER.sub("", last.text) == NUMBER.sub("", text):
            self.events[-1] = replace(last, at=at, text=text, level=level, count=last.count + 1)
        else:
            self.events.append(Event(at, text, level))

    def tick(self, now: float) -> None:
        """To be called about once a second: notices that the node is gone."""
        if self.heard is not None and not self.gone and now - self.heard > SILENT_S:
            self.gone = True
            for series in (self.states, self.measures):  # lines are broken here
                series.add(self.heard + series.step_s, np.nan)
            self._begin(self.heard, "gone")
            self.note(self.heard, "nothing heard of the node from here on", BAD)

    def _hear(self, at: float) -> None:
        if self.gone and self.heard is not None:
            away = at - self.heard
            self.note(at, f"the node is back after {f'{away:.0f} s' if away < 90 else f'{away / 60:.0f} min'}", GOOD)
            self.gone, self.state, self._back = False, None, at
        elif self.heard is None:
            self.note(at, "the node is heard", NEUTRAL)
        self.heard = at

    def _begin(self, at: float, status: str) -> None:
        if not self.spans or self.spans[-1][1] != status:
            self.spans.append((at, status))

    # ---- what is shown ------------------------------------------------------------------------------------------------

    def pose_at(self, at: float) -> Matrix | None:
        """T_camera_lidar (4, 4) that held at a time, the first one heard for times before it; None if nothing was heard yet."""
        rows = self.states.rows(-math.inf)
        rows = rows[np.isfinite(rows[:, 1:13]).all(axis=1)]
        if not len(rows):
            return self._first
        row = rows[max(int(np.searchsorted(rows[:, 0], at, side="right")) - 1, 0)]
        return np.vstack([row[1:13].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])

    def poses(self, since: float, reference: Matrix | None = None, most: int = 300) -> Matrix:
        """(n, 14): time; rotation about x, y, z in deg and translation in cm relative to T_camera_lidar `reference` (4, 4; None =
        the first one heard), in camera axes; their standard deviations in the same units; drift."""
        rows = self.states.rows(since, most)
        reference = self._first if reference is None else reference
        out = np.full((len(rows), 14), np.nan)
        out[:, 0] = rows[:, 0]
        known = np.isfinite(rows[:, 1:13]).all(axis=1)
        if reference is not None and known.any():
            T = np.zeros((int(known.sum()), 4, 4))
            T[:, :3], T[:, 3, 3] = rows[known, 1:13].reshape(-1, 3, 4), 1
            moved = T @ se3.inverse(reference)
            out[known, 1:4] = np.rad2deg(Rotation.from_matrix(moved[:, :3, :3]).as_rotvec())
            # Of the camera's position, as people think of it: the same as the six-vector's to second order near the reference.
            out[known, 4:7] = 100 * (T[:, :3, 3] - reference[:3, 3])
        out[:, 7:10], out[:, 10:13], out[:, 13] = np.rad2deg(rows[:, 13:16]), 100 * rows[:, 16:19], rows[:, 19]
        return out

    def strip(self, since: float, now: float) -> list[tuple[float, float, str]]:
        """The statuses from `since` to `now`: begin, end, status; without holes, but for before the first."""
        bounds = pairwise([*self.spans, (now, "")])
        return [(max(begin, since), end, status) for (begin, status), (end, _) in bounds if end > since]


def moment_of(clock: str, now: float) -> float | None:
    """The last time, s since the epoch, at which it was HH:MM or HH:MM:SS by the local clock; None for what is no time of day."""
    try:
        at = time.strptime(clock, "%H:%M:%S" if clock.count(":") == 2 else "%H:%M")
    except ValueError:
        return None
    day = time.localtime(now)
    moment = time.mktime((*day[:3], *at[3:6], 0, 0, -1))
    return moment if moment <= now else moment - 24 * HOUR

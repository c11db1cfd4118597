"""When estimates are made, and what the CPU time that online.max_load allows is spent on.

The budget counts the CPU time of threads, not how long they take: other processes on the same cores do not make the node do less.
Every pair is looked at, whatever it costs; keyframes, then estimates, then classes wait until the budget allows for them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import Enum

from calib_ros.config import OnlineConfig
from calib_ros.config.online import MANUAL, PERIODIC
from calib_ros.frame import NANOSECONDS
from calib_ros.registration.search.parallel import cpu_time

# Work saved up while there was little to do, in s of the whole budget: the first keyframes and the first search come at once, and
# a minute's average is at most a twelfth above max_load.
SAVED_S = 5.0
# Whatever the budget says, one keyframe is taken in so many seconds, and one estimate made that is due: a node that tests nothing
# is of no use. The test of a displaced mount takes three keyframes, 15 s at this rate.
KEYFRAME_EVERY_S = 5.0
ESTIMATE_EVERY_S = 30.0
CLASSES_EVERY_S = 30.0  # of one keyframe
# At rest estimates are at most so far apart, s: the tracker expects the mount to drift in a minute. Keyframes come so many times
# as often, from the first distance to the longest, s: within the 5 s in which a displacement is to be told that no look sees.
LONGEST_REST_S, KEYFRAMES_PER_REST, REST_SPACING_S = 60.0, 6, (2.0, 5.0)
CLASSES_RESERVE = 0.5  # share of what can be saved up that must be there for classes: keyframes and estimates have the rest


def is_due(last: int | None, stamp: int, every_s: float, in_step: bool = False) -> bool:
    """Whether what was done at a stamp, ns, is to be done again at another one; where a clock was set back, at once.

    in_step: with all others that do it as often, at the first stamp of every interval of the clock.
    """
    if last is None or stamp < last:
        return True
    elapsed, period = stamp - last, round(every_s * NANOSECONDS)
    if not in_step or elapsed >= 1.5 * period:
        return elapsed >= period
    return 2 * elapsed >= period and stamp // period > last // period


class Work(Enum):
    """What the CPU time goes into. The values are names for people."""

    MESSAGES = "messages"  # receiving them, services and timers: the executor's thread
    INTAKE = "intake"  # every pair: decoding, sensor checks, comparison with the last keyframe
    KEYFRAMES = "keyframes"  # motion, features, the monitor's test
    CLASSES = "classes"
    ESTIMATES = "estimates"
    CHECKS = "checks"  # of an extrinsic, on request


@dataclass(frozen=True)
class LoadCounts:
    """What has been counted so far. seconds: CPU time by kind of work. keyframes: taken; postponed: frames that were to be
    keyframes, but had to wait; forced: keyframes beyond the budget, taken for KEYFRAME_EVERY_S."""

    seconds: dict[Work, float] = field(default_factory=dict)
    keyframes: int = 0
    postponed: int = 0
    forced: int = 0


class Purse:
    """What has been saved up, s of CPU time, and until when, by the clock; of one budget, or of several that share it. lock:
    to be held. clock: s, never runs back."""

    def __init__(self, config: OnlineConfig, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock, self.lock = clock, threading.Lock()
        self.at, self.saved = clock(), SAVED_S * config.max_load
        self.last_estimate_s = 0.0  # CPU time of the last estimate of any


class LoadBudget:
    """Saves up max_load seconds of CPU time per second, up to SAVED_S seconds of it, and spends it on the work. Thread-safe.

    What is done is known only afterwards: the budget may be overdrawn by one keyframe or estimate, and what comes next waits
    until that is made up for. An estimate that waits and the keyframes take turns, by the CPU time that they take: else keyframes
    would use up whatever is there. config may be replaced at any time. purse: shared with others, each of which has
    turns of its own, and its least of keyframes and estimates.
    """

    def __init__(self, config: OnlineConfig, clock: Callable[[], float] = time.monotonic, purse: Purse | None = None) -> None:
        self.config = config
        self._purse = purse or Purse(config, clock)
        self._seconds = dict.fromkeys(Work, 0.0)
        self._keyframes = self._postponed = self._forced = 0
        self._last = dict.fromkeys((Work.KEYFRAMES, Work.ESTIMATES, Work.CLASSES), -float("inf"))  # when the last one began
        self._estimate_waits = False
        self._last_estimate_s = self._keyframes_since_s = 0.0  # CPU time of the last estimate, and of the keyframes since
        self._executor: tuple[int, float] | None = None  # clock of the executor's thread, and what it showed last

    # ---- what is done -------------------------------------------------------------------------------------------------

    @contextmanager
    def counting(self, work: Work, charged: bool = True) -> Iterator[Callable[[Work], None]]:
        """Counts the CPU time of this thread and of the threads that share its work. Gives what is to be told when another kind
        of work begins. charged: False for what somebody asked for, which comes on top of the budget."""
        since = cpu_time()

        def switch(to: Work) -> None:
            nonlocal work, since
            now = cpu_time()
            self.add(work, now - since, charged)
            work, since = to, now

        try:
            yield switch
        finally:
            switch(work)

    def add(self, work: Work, seconds: float, charged: bool = True) -> None:
        """So much CPU time went into this."""
        with self._purse.lock:
            self._update()
            self._seconds[work] += seconds
            if not charged:
                return
            self._purse.saved -= seconds
            if work is Work.KEYFRAMES:
                self._keyframes_since_s += seconds
            elif work is Work.ESTIMATES:
                self._last_estimate_s, self._keyframes_since_s = seconds, 0.0
                self._purse.last_estimate_s = seconds
            # Intake goes on whatever it costs. Large debts are forgiven, or a larger max_load would help only after hours.
            self._purse.saved = max(self._purse.saved, -max(SAVED_S, self._purse.last_estimate_s))

    def count_messages(self) -> None:
        """The calling thread receives the messages: its CPU time counts from now on. Does nothing where it cannot be told."""
        if not hasattr(time, "pthread_getcpuclockid"):
            return
        with self._purse.lock, suppress(OSError):
            own = time.pthread_getcpuclockid(threading.get_ident())
            if self._executor is None or self._executor[0] != own:
                self._executor = own, time.clock_gettime(own)

    # ---- what may be done ---------------------------------------------------------------------------------------------

    def allows_keyframe(self) -> bool:
        """True if a frame that is to be a keyframe may be one; it is counted as one then."""
        with self._purse.lock:
            now = self._update()
            turn = not self._estimate_waits or self._keyframes_since_s < self._last_estimate_s
            affordable = self._purse.saved >= 0 and turn
            if not affordable and now - self._last[Work.KEYFRAMES] < KEYFRAME_EVERY_S:
                self._postponed += 1
                return False
            self._keyframes += 1
            self._forced += not affordable
            self._last[Work.KEYFRAMES] = now
            return True

    def allows_estimate(self, due: bool) -> bool:
        """True if an estimate is due and may begin. If it is due and may not, keyframes make room for it."""
        with self._purse.lock:
            now = self._update()
            affordable = self._purse.saved >= 0 or now - self._last[Work.ESTIMATES] >= ESTIMATE_EVERY_S
            self._estimate_waits = due and not affordable
            return due and affordable

    def start_estimate(self) -> None:
        """An estimate begins, on request or not."""
        with self._purse.lock:
            self._last[Work.ESTIMATES], self._estimate_waits = self._purse.clock(), False

    def allows_classes(self, needed: bool = False) -> bool:
        """True if a keyframe may be given classes. needed: without them there will be no estimate."""
        with self._purse.lock:
            now = self._update()
            enough = self._purse.saved >= CLASSES_RESERVE * SAVED_S * self.config.max_load
            allowed = needed or enough or now - self._last[Work.CLASSES] >= CLASSES_EVERY_S
            if allowed:
                self._last[Work.CLASSES] = now
            return allowed

    # ---- what has been done -------------------------------------------------------------------------------------------

    def counts(self) -> LoadCounts:
        """Everything so far."""
        with self._purse.lock:
            self._update()
            return LoadCounts(dict(self._seconds), self._keyframes, self._postponed, self._forced)

    def _update(self) -> float:
        """With the lock held: the time, with what was saved up and received until then."""
        now = self._purse.clock()
        limit = self.config.max_load
        self._purse.saved = min(self._purse.saved + limit * (now - self._purse.at), SAVED_S * limit)
        self._purse.at = now
        if self._executor is not None:
            own, before = self._executor
            with suppress(OSError):  # the thread has ended
                spent = time.clock_gettime(own)
                self._executor = own, spent
                self._seconds[Work.MESSAGES] += spent - before
                self._purse.saved -= spent - before
        return now


class Schedule:
    """When estimates are made, by online.mode over the data's own stamps: a recording gives the same ones at any speed.

    While the extrinsic is at rest less is done, the less, the longer it has been steady: an estimate is worth its time once there
    is as much to go on again as there was, and keyframes only test the extrinsic. config may be replaced at any time. newest:
    stamp of the newest frame. in_step: with others, see `is_due`. Stamps are in ns.
    """

    def __init__(self, config: OnlineConfig, in_step: bool = False) -> None:
        self.config, self._in_step = config, in_step
        self.newest: int | None = None
        self._estimated: int | None = None
        self._estimated_before: int | None = None
        self._steady_since: int | None = None
        self._steady_s = self._steady_by_estimate_s = 0.0  # from then to the newest frame, and to the last estimate

    def add_frame(self, stamp: int, steady: bool = False) -> None:
        """A frame, keyframe or not, with its stamp, and whether the extrinsic is steady by now."""
        self.newest = stamp
        if not steady:
            self._steady_since = None
        elif self._steady_since is None or stamp < self._steady_since:
            self._steady_since = stamp
        self._steady_s = 0.0 if self._steady_since is None else (stamp - self._steady_since) / NANOSECONDS

    def start_estimate(self) -> None:
        """An estimate begins, on request or not: the next period counts from the newest frame."""
        self._estimated_before, self._estimated = self._estimated, self.newest
        self._steady_by_estimate_s = self._steady_s

    def cancel_estimate(self) -> None:
        """The estimate that began last ended without a result."""
        self._estimated = self._estimated_before

    def due(self, at_rest: bool = False, waits: bool = False, urgent: bool = False) -> bool:
        """True if new keyframes are to be estimated now; the first ones at once, as after a clock was set back.

        at_rest: in mode continuous as long after the last estimate as the extrinsic was steady by then. waits: it is as good as
        at rest. urgent: it has moved or is to be confirmed, for which mode periodic does not wait.
        """
        if self.config.mode == MANUAL:
            return False
        periodic = self.config.mode == PERIODIC
        if self.newest is None or self._estimated is None or (periodic and urgent):
            return True
        wait_s = self.config.rest_period_s if at_rest or waits else 0.0
        if at_rest:
            wait_s = max(wait_s, min(self._steady_by_estimate_s, LONGEST_REST_S))
        elapsed = (self.newest - self._estimated) / NANOSECONDS
        return elapsed < 0 or elapsed >= (self.config.period_s if periodic else wait_s)

    @property
    def keyframes_at_rest_s(self) -> float:
        """Smallest time between keyframes, s."""
        shortest, longest = REST_SPACING_S
        spacing_s = min(max(shortest, self._steady_s / KEYFRAMES_PER_REST), longest)
        # Cameras come to rest at different times, and halves of the longest are in step with it.
        return spacing_s if not self._in_step or spacing_s == longest else longest / 2

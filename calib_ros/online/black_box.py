"""The node's black box: what has happened lately, and when it is worth a record of the raw data."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import Any

from calib_ros.online.events import Event, ExtrinsicUpdated, FrameIngested, Problem
from calib_ros.online.pipeline import Pipeline
from calib_ros.result import BLINDED, INITIAL, MOVED, REFUSED, SUSPECT, Extrinsic, Result

KINDS = (MOVED, REFUSED, SUSPECT, BLINDED)  # statuses that are worth a record
KEPT_EVENTS = 500  # some minutes of keyframes, and a file that a person still reads
# After an occasion: so many keyframes, the first of which may be the one that shows it, and no longer than so many seconds.
KEYFRAMES_AFTER, LONGEST_AFTER_S = 4, 5.0
SPACING_S = 60.0  # between records of a kind: a status that flaps would fill the disk with the same


@dataclass(eq=False)
class Occasion:
    """Something worth a record, which waits for further keyframes. kind: of KINDS. result: the extrinsic that was used, with the
    status and reason of the occasion. event: the last one of the record. due: by the clock."""

    kind: str
    result: Result
    event: dict[str, Any]
    due: float
    keyframes: int = KEYFRAMES_AFTER


class BlackBox:
    """Hears the pipeline's events and keeps the newest; records every occasion of a kind that is wanted. Thread-safe.

    kinds: gives those wanted at present. record: takes an occasion, and what has happened until then as JSON lines; must return
    at once. clock: s.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        kinds: Callable[[], Sequence[str]],
        record: Callable[[Occasion, str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._pipeline, self._kinds, self._record, self._clock = pipeline, kinds, record, clock
        self._lock = threading.Lock()
        self._events: deque[dict[str, Any]] = deque(maxlen=KEPT_EVENTS)
        self._last: Extrinsic | None = None
        self._relied_on: Result | None = None  # the newest extrinsic that was usable
        self._pending: list[Occasion] = []
        self._begun: dict[str, float] = {}  # the newest occasion of each kind, by the clock

    def add(self, event: Event) -> None:
        """An event of the pipeline."""
        with self._lock:
            if isinstance(event, ExtrinsicUpdated):
                self._update(event.extrinsic, event.stamp)
            elif isinstance(event, FrameIngested) and self.wants(event):
                self._events.append(self._keyframe(event.frame.stamp))
                for pending in self._pending:
                    pending.keyframes -= 1
        if isinstance(event, Problem):
            self.note(event.message)
        self.check()

    def wants(self, event: FrameIngested) -> bool:
        """Whether the messages of a frame belong into records: a keyframe's, and those that show that a sensor is blind. To be
        asked before the event is added."""
        blind = any(own.kind == BLINDED and own.keyframes == KEYFRAMES_AFTER for own in list(self._pending))
        return event.is_keyframe or blind

    def note(self, message: str, kind: str = "problem") -> None:
        """Something else that has happened, in a line. The same again is counted: one may come with every frame."""
        with self._lock:
            last = self._events[-1] if self._events else {}
            if last.get("message") == message:
                last["times"] = last.get("times", 1) + 1
            else:
                self._events.append(_event(kind, last.get("stamp_ns", 0), message=message))

    def check(self, flush: bool = False) -> None:
        """To be called about once a second: record the occasions whose time is up. flush: all, now."""
        with self._lock:
            now = self._clock()
            done = [own for own in self._pending if flush or own.keyframes <= 0 or now >= own.due]
            self._pending = [own for own in self._pending if own not in done]
            records = [(own, _lines([*self._events, own.event])) for own in done]
        for record in records:
            self._record(*record)

    def events(self) -> str:
        """What has happened until now, as JSON lines."""
        with self._lock:
            return _lines(self._events)

    def _update(self, extrinsic: Extrinsic, stamp: int) -> None:
        """With the lock held: a new extrinsic or status."""
        result, last, now = extrinsic.result, self._last, self._clock()
        self._last = extrinsic
        changed = last is None or last.result.status != result.status
        # Also behind another status, as that of a mount that has moved.
        refused = result.optimum is not None and (last is None or result.optimum is not last.result.optimum)
        refused = refused or result.status == REFUSED
        doubted, accepted = result.status in (SUSPECT, MOVED), last is not None and last.accepted != extrinsic.accepted
        kind = "status" if changed else "refusal" if refused else "alarm" if doubted and not accepted else "estimate"
        event = _event(
            kind,
            stamp,
            status=result.status,
            reason=result.reason,
            usable=extrinsic.usable,
            accepted=extrinsic.accepted,
            frames_used=result.frames_used,
            score=result.score,
            drift=extrinsic.normalised_innovation,
            monitor=extrinsic.monitor_message,
            p_value=extrinsic.p_value,
            refusal=None if result.refusal is None else result.refusal.value,
            refusal_figures=dict(result.refusal_figures),
            cause=None if result.cause is None else result.cause.value,
            disputed_since_ns=extrinsic.disputed_since if doubted else 0,
        )
        self._events.append(event)
        if extrinsic.usable or result.status == INITIAL:
            self._relied_on = result
        for kind in self._kinds():
            happens = (changed and kind == result.status) or (refused and kind == REFUSED)
            if happens and now - self._begun.get(kind, -math.inf) >= SPACING_S:
                self._begun[kind] = now
                said = ("status", "reason", "refusal", "refusal_figures", "cause", "optimum")
                used = replace(self._relied_on or result, **{name: getattr(result, name) for name in said})
                capture = {**event, "event": "capture", "kind": kind}
                self._pending.append(Occasion(kind, used, capture, now + LONGEST_AFTER_S))

    def _keyframe(self, stamp: int) -> dict[str, Any]:
        pipeline, counts = self._pipeline, self._pipeline.pairing.synchronizer.counts
        came: dict[str, Any] = {"images": counts.images, "clouds": counts.clouds, "pairs": counts.pairs}
        if (recalibrator := pipeline.recalibrator) is not None:
            current, newest = recalibrator.current, recalibrator.newest()
            came |= {"monitor": current.monitor_message, "p_value": current.p_value}
            if newest is not None and newest.twist is not None and newest.stamp == stamp:
                came["twist"] = newest.twist.tolist()
        return _event("keyframe", stamp, dropped=pipeline.dropped_pairs, **came)


def _event(kind: str, stamp: int, **values: Any) -> dict[str, Any]:
    """stamp: ns, of the newest data."""
    now = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
    known = {name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in values.items()}
    return {"time": now, "stamp_ns": int(stamp), "event": kind, **known}


def _lines(events: Sequence[dict[str, Any]] | deque[dict[str, Any]]) -> str:
    return "".join(f"{json.dumps(event)}\n" for event in events)

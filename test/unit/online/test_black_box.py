"""What is kept and told of what happens: occasions that the black box records, with what led to them, and lines in the log."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from driven import Driven, config
from sample_sources import frames

from calib_ros.config import Config
from calib_ros.frame import Frame, PointCloud
from calib_ros.online.black_box import KEPT_EVENTS, KEYFRAMES_AFTER, LONGEST_AFTER_S, SPACING_S, BlackBox, Occasion
from calib_ros.online.events import ExtrinsicUpdated, FrameIngested, Inputs, Problem, QuietLog
from calib_ros.online.pipeline import Pipeline
from calib_ros.registration.initial_guess import nominal
from calib_ros.result import BLINDED, CONVERGED, MOVED, REFUSED, SUSPECT, Extrinsic, RefusalCode, Result
from calib_ros_synthetic.drive import SyntheticDrive

STAMP = 7_000_000_000
(FRAME,) = frames(1)


class Box(BlackBox):
    """One that notes what is to be recorded, by a clock that a test turns."""

    def __init__(self, *kinds: str) -> None:
        self.now, self.kinds, self.recorded = 0.0, list(kinds), list[tuple[Occasion, str]]()
        inputs = Inputs(lambda *_: FRAME, lambda *_: ("camera", "lidar"), lambda *_: None)
        self.pipeline = Pipeline(Config(), inputs, lambda event: None)
        super().__init__(self.pipeline, lambda: self.kinds, lambda *own: self.recorded.append(own), lambda: self.now)

    def says(self, status: str, usable: bool = False, T: np.ndarray | None = None, **values: Any) -> None:
        own = {name: values.pop(name) for name in ("p_value", "disputed_since", "accepted") if name in values}
        result = Result(nominal() if T is None else T, status, values.pop("reason", f"it is {status}"), **values)
        self.add(ExtrinsicUpdated(Extrinsic(result, usable=usable, **own), STAMP))

    def keyframes(self, count: int) -> None:
        for _ in range(count):
            self.add(FrameIngested(FRAME, True, None, None))

    @property
    def kinds_recorded(self) -> list[str]:
        return [occasion.kind for occasion, _ in self.recorded]


@pytest.fixture
def box() -> Iterator[Box]:
    made = Box(MOVED, REFUSED, SUSPECT, BLINDED)
    yield made
    assert made.pipeline.stop()


def test_a_record_waits_for_some_keyframes_more(box: Box) -> None:
    box.says(CONVERGED, True)
    box.says(MOVED)
    box.keyframes(KEYFRAMES_AFTER - 1)
    assert box.recorded == []
    box.keyframes(1)
    box.keyframes(9)
    assert box.kinds_recorded == [MOVED]


def test_where_none_come_it_waits_for_some_seconds_or_the_end(box: Box) -> None:
    box.says(MOVED)
    box.now = LONGEST_AFTER_S - 0.1
    box.check()
    assert box.recorded == []
    box.now = LONGEST_AFTER_S
    box.check()
    assert box.kinds_recorded == [MOVED]
    box.says(BLINDED)
    box.check(flush=True)
    box.check(flush=True)
    assert box.kinds_recorded == [MOVED, BLINDED]


def test_a_status_that_flaps_is_recorded_once_a_minute(box: Box) -> None:
    for _ in range(4):
        box.says(SUSPECT)
        box.says(CONVERGED, True)
        box.now += SPACING_S / 3
    box.says(MOVED)  # of another kind
    box.check(flush=True)
    assert box.kinds_recorded == [SUSPECT, SUSPECT, MOVED]


def test_only_what_is_wanted_at_present_is_recorded(box: Box) -> None:
    box.kinds = [BLINDED]
    box.says(MOVED)
    box.kinds = [MOVED]
    box.says(MOVED, reason="still")  # no change
    box.says(BLINDED)
    box.check(flush=True)
    assert box.recorded == []
    box.says(MOVED)
    box.check(flush=True)
    assert box.kinds_recorded == [MOVED]


def test_every_refused_estimate_is_an_occasion_also_while_the_mount_has_moved(box: Box) -> None:
    refusal = {"refusal": RefusalCode.LOW_SCORE, "optimum": np.eye(4)}
    box.kinds = [REFUSED]
    box.says(MOVED)
    box.check(flush=True)
    assert box.recorded == []
    box.says(MOVED, **refusal)
    box.now += SPACING_S
    box.says(MOVED, **refusal)  # the same one, with another status of the rest
    box.says(REFUSED)
    box.now += SPACING_S
    box.says(REFUSED)  # one more
    box.check(flush=True)
    assert box.kinds_recorded == [REFUSED] * 3
    assert [json.loads(events.splitlines()[-1])["status"] for _, events in box.recorded] == [MOVED, REFUSED, REFUSED]


def test_what_is_recorded_is_the_extrinsic_that_was_used(box: Box) -> None:
    """Not that of the estimate which says that it has moved."""
    T = nominal(3.0)
    box.says(CONVERGED, True, T, covariance=np.eye(6), score=0.7)
    box.says(MOVED, False, nominal(9.0), score=0.1)
    box.check(flush=True)
    result = box.recorded[0][0].result
    assert np.array_equal(result.T_camera_lidar, T)
    assert (result.status, result.reason, result.score) == (MOVED, "it is moved", 0.7)


def test_events_tell_what_led_to_it(box: Box) -> None:
    box.says(CONVERGED, True, accepted=1, p_value=math.nan)
    box.keyframes(1)
    box.says(CONVERGED, True, accepted=2)
    box.says(SUSPECT, p_value=1e-9, disputed_since=STAMP - 1)
    box.says(SUSPECT, p_value=1e-12, disputed_since=STAMP - 1)
    box.says(MOVED, accepted=2, refusal=RefusalCode.LOW_SCORE, refusal_figures={"score": 0.1}, optimum=np.eye(4))
    box.add(Problem("the cloud has no intensity", "intensity"))
    box.add(Problem("the cloud has no intensity", "intensity"))
    box.note("no messages on points", "health")
    box.check(flush=True)
    assert {*box.kinds_recorded} == {SUSPECT, MOVED, REFUSED}
    told = {occasion.kind: [json.loads(line) for line in events.splitlines()] for occasion, events in box.recorded}
    suspect, moved = told[SUSPECT], told[MOVED]
    assert [event["event"] for event in moved] == [
        *("status", "keyframe", "estimate", "status", "alarm", "status", "problem", "health", "capture")
    ]
    assert [event["kind"] for event in (suspect[-1], moved[-1])] == [SUSPECT, MOVED]
    assert moved[0]["p_value"] is None
    assert moved[1]["stamp_ns"] == FRAME.stamp
    assert moved[1].keys() >= {"time", "images", "clouds", "pairs", "dropped"}
    assert (moved[4]["p_value"], moved[4]["disputed_since_ns"]) == (1e-12, STAMP - 1)
    assert (moved[5]["refusal"], moved[5]["refusal_figures"]) == ("low_score", {"score": 0.1})
    assert (moved[6]["message"], moved[6]["times"]) == ("the cloud has no intensity", 2)
    assert moved[7]["message"] == "no messages on points"
    box.keyframes(2 * KEPT_EVENTS)
    assert len(box.events().splitlines()) == KEPT_EVENTS


def test_what_differs_in_its_figures_alone_is_one_line_ever_more_rarely_and_counted() -> None:
    now, lines = [0.0], list[str]()
    log = QuietLog(lambda: now[0])
    for tenth in range(350):
        now[0] = tenth / 10
        log.add("cloud", f"{tenth} points", lines.append)
        if tenth in (3, 4):
            log.add("camera", "no image", lines.append)
        log.catch_up()
    assert lines == ["0 points", "no image", "100 points (99 more in 10 s)", "no image", "300 points (199 more in 20 s)"]
    for now[0] in (69.0, 70.0, 140.0):  # what came last is told although nothing comes any more
        log.catch_up()
    assert lines[5:] == ["349 points (48 more in 40 s)"]


def test_a_blinded_sensor_is_told_when_it_begins_to_be_for_another_reason_and_when_it_sees(
    drive: SyntheticDrive, street: list[Frame]
) -> None:
    dark = replace(street[1], image=np.zeros_like(street[1].image))
    empty = replace(street[1], cloud=PointCloud(np.zeros((0, 3), np.float32)))
    frames = iter(k * 10**8 for k in range(1, 100))

    def later(frame: Frame) -> Frame:
        return replace(frame, stamp=street[1].stamp + next(frames), cloud_stamp=None)

    with Driven(drive, config(mode="manual")) as driven:
        driven.feed(*street[:2], *(later(frame) for frame in [dark] * 6 + [empty] * 6 + [street[1]] * 2))
    said = [line for line in driven.errors if "intensity" not in line]
    assert [line.partition(" (")[0] for line in said] == ["the camera shows nothing", "the LiDAR shows nothing"]
    assert driven.notices == ["camera and LiDAR work again"]

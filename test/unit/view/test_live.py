"""The history of a node: bounded, thinned evenly, with gaps, events and statuses."""

from __future__ import annotations

import asyncio
import math
import re
import time
from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest
from fastapi import FastAPI

from calib_ros import se3
from calib_ros.result import CONVERGED, MOVED, Result
from calib_ros_check.rig.shown import GOOD
from calib_ros_view.node.calls import Answer
from calib_ros_view.session.live import MAX_EVENTS, Diagnosis, Event, LiveHistory, NodeState, Ring, moment_of
from calib_ros_view.web.live_page import Gallery
from calib_ros_view.web.live_words import numbers_html
from calib_ros_view.web.server import Pictures

T0 = 1_000_000.0
POSE = se3.from_parts(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), [0.1, -0.2, -0.3])


def state(T: np.ndarray = POSE, status: str = CONVERGED, reason: str = "", usable: bool = True) -> NodeState:
    sigma = np.diag(np.square([*np.deg2rad([0.1, 0.2, 0.3]), 0.01, 0.02, 0.03]))
    return NodeState(Result(T, status, reason, 0.5, sigma), 0.4, usable, 0.1)


def test_an_hour_at_ten_hertz_is_thinned_evenly_and_memory_stays() -> None:
    ring = Ring(2)
    for k in range(2 * 36000):
        ring.add(T0 + k / 10, [k, -k])
    rows = ring.rows()
    assert 1798 <= len(rows) <= 1800
    assert set(np.diff(rows[:-1, 0]).round(3)) == {2.0}
    assert rows[-1, 1] == 71999, "the newest is always there"
    assert rows[-1, 0] - rows[0, 0] <= 3600
    fewer = ring.rows(most=100)
    assert len(fewer) == 100
    assert fewer[-1, 1] == 71999
    ring.add(T0 - 1000, [1, 2])
    assert ring.rows()[:, 1:].tolist() == [[1, 2]], "a clock that jumps back begins the series anew"


def test_a_converged_extrinsic_that_nothing_checks_any_more_is_not_said_to_be_checked() -> None:
    assert "every check of it passed" in state().words
    assert "nothing checks it now" in state(usable=False).words
    assert "do not use it" in state(status=MOVED, usable=False).words


def test_keyframes_are_drawn_again_whenever_there_are_twice_as_many() -> None:
    page = Gallery(None, None)  # type: ignore[arg-type]
    seen = (0, 1, 1, *range(1, 21), 20, 20, 0, 3, 3)  # they were forgotten in between
    assert [n for n in seen if page.is_due(n)] == [1, 2, 4, 8, 16, 3]


def test_keyframes_are_drawn_into_pictures_in_memory() -> None:
    facts = {"score": math.nan, "in_view": 8, "edge_points": 9}
    drawn = [SimpleNamespace(data=b"new", age=0.0, **facts), SimpleNamespace(data=b"old", age=2.0, **facts)]
    answer: Future[Answer] = Future()
    answer.set_result(Answer(True, "", SimpleNamespace(keyframes=drawn, cpu=0.008)))
    app, pictures = FastAPI(), Pictures()
    pictures.routes(app)
    page = Gallery(SimpleNamespace(name="/calib_ros", keyframes=lambda: answer), pictures)  # type: ignore[arg-type]
    asyncio.run(page.draw())
    assert page.note == "2 keyframes, drawn in 8 ms of the node's CPU time"
    assert re.findall('src="([^"]+)"', page.content) == [f"/picture/keyframe {k} calib_ros?v={k}" for k in (0, 1)]
    serve = app.routes[-1].endpoint  # type: ignore[attr-defined]
    served = [serve(name) for name in ("keyframe 0 calib_ros", "keyframe 1 calib_ros", "overlay calib_ros")]
    assert [(own.status_code, own.body) for own in served] == [(200, b"new"), (200, b"old"), (404, b"")]
    assert pictures.put("rig/front", same := b"one") == pictures.put("rig/front", same) == "/picture/rig front?v=2"
    assert pictures.put("rig/front", b"another") == "/picture/rig front?v=3"


def test_poses_are_relative_to_the_first_or_to_a_chosen_one_with_their_band() -> None:
    history = LiveHistory(T0)
    moved = se3.perturb(POSE, [0.0, 0.5, 0.0], [0.0, 0.0, 0.0])
    moved[:3, 3] = POSE[:3, 3] + [0.0, 0.03, 0.0]
    history.add_extrinsic(T0, state())
    history.add_extrinsic(T0 + 10, state(moved))
    rows = history.poses(0)
    assert rows[0, 1:7] == pytest.approx(0, abs=1e-9)
    assert rows[1, 1:7] == pytest.approx([0, 0.5, 0, 0, 3, 0], abs=1e-6)
    assert rows[1, 7:13] == pytest.approx([0.1, 0.2, 0.3, 1, 2, 3])
    assert history.poses(0, moved)[0, 2] == pytest.approx(-0.5)
    assert len(history.poses(T0 + 5)) == 1
    shown = numbers_html(history)  # in the units of the charts
    assert "<span>1σ rotation, °</span><b>0.300</b>" in shown
    assert "<span>1σ translation, cm</span><b>3.0</b>" in shown


def test_another_process_of_the_node_is_told_from_one_that_was_silent() -> None:
    history = LiveHistory(T0)
    history.add_diagnosis(T0, Diagnosis(values={"images": "50"}))
    history.tick(T0 + 10)
    history.add_extrinsic(T0 + 20, state())
    history.add_diagnosis(T0 + 21, Diagnosis(values={"images": "60"}))
    assert history.restarted < 0, "it only was silent"
    history.tick(T0 + 30)
    history.add_extrinsic(T0 + 40, state())
    history.add_diagnosis(T0 + 41, Diagnosis(values={"images": "3"}))
    assert history.restarted == T0 + 40, "since it is heard again"
    history.add_diagnosis(T0 + 43, Diagnosis(values={"images": "1"}))
    assert history.restarted == T0 + 43, "too quickly to be gone in between"


def test_the_pose_of_any_moment_can_be_the_reference() -> None:
    history = LiveHistory(T0)
    assert history.pose_at(T0) is None
    turned = [se3.perturb(POSE, [0.0, 0.1 * k, 0.0], [0.0, 0.0, 0.0]) for k in range(3)]
    for k, T in enumerate(turned):
        history.add_extrinsic(T0 + 10 * k, state(T))
    history.tick(T0 + 100)  # the gap is no pose
    for at, k in ((-5, 0), (0, 0), (9.9, 0), (10, 1), (19, 1), (500, 2)):
        assert history.pose_at(T0 + at) == pytest.approx(turned[k]), at
    assert history.poses(0, history.pose_at(T0 + 15))[0, 2] == pytest.approx(-0.1)


def test_a_time_of_day_is_the_last_moment_that_had_it() -> None:
    now = time.mktime((2026, 3, 10, 0, 20, 30, 0, 0, -1))
    assert moment_of("00:20:30", now) == now
    assert moment_of("00:20", now) == now - 30
    assert moment_of("23:50:00", now) == now - 30 * 60 - 30, "of the day before"
    for text in ("", "12", "ab:cd", "24:00", "12:61:00", "1:2:3:4", "-1:00", "None"):
        assert moment_of(text, now) is None, text


def test_a_node_that_is_silent_is_gone_since_its_last_word_and_comes_back() -> None:
    history = LiveHistory(T0)
    history.tick(T0 + 100)
    assert (history.strip(0, T0 + 100), len(history.poses(0)), history.heard) == ([], 0, None)
    history.add_extrinsic(T0 + 100, state())
    history.tick(T0 + 103)
    assert not history.gone
    for after in (105, 106, 107):
        history.tick(T0 + after)
    assert (history.gone, history.heard) == (True, T0 + 100)
    assert np.isnan(history.poses(0)[-1, 1]), "the line is broken"
    history.add_extrinsic(T0 + 130, state())
    assert not history.gone
    texts = [event.text for event in history.events]
    assert [text for text in texts if "node" in text] == [
        "the node is heard",
        "nothing heard of the node from here on",
        "the node is back after 30 s",
    ]
    assert history.strip(0, T0 + 140) == [
        (T0 + 100, T0 + 100, CONVERGED),
        (T0 + 100, T0 + 130, "gone"),
        (T0 + 130, T0 + 140, CONVERGED),
    ]


def test_statuses_are_events_with_their_reason_and_repetitions_are_counted() -> None:
    history = LiveHistory(T0)
    history.add_extrinsic(T0, state())
    history.add_extrinsic(T0 + 1, state())
    history.add_extrinsic(T0 + 2, state(status=MOVED, reason="searched anew", usable=False))
    assert history.events[-1].text == "moved: searched anew"
    assert history.state is not None and history.state.level == "bad"  # noqa: PT018
    for k in range(3):
        history.note(T0 + 3 + k, f"{k} % get lost")
    assert history.events[-1] == Event(T0 + 5, "2 % get lost", count=3)
    for k in range(2 * MAX_EVENTS):
        history.note(T0 + 10 + k, f"event {'ab'[k % 2]}")
    assert len(history.events) == MAX_EVENTS


def test_diagnostics_give_rates_loads_estimates_and_restarts() -> None:
    history = LiveHistory(T0)
    values = {"images": "100", "images per s": "10.0", "CPU, share of a core": "0.29 of 0.5", "monitor p-value": "0.04"}
    history.add_diagnosis(T0, Diagnosis(0, "converged", {**values, "estimates accepted": "3", "drift": "0.2"}))
    assert history.measures.rows()[0, [1, 2, 5]].tolist() == [0.04, 10.0, 0.29]
    assert (history.events[-1].text, history.events[-1].level) == ("estimate accepted, drift 0.2", GOOD)
    history.add_diagnosis(T0 + 1, Diagnosis(0, "", {"images": "2", "monitor p-value": "unknown"}))
    assert "started anew" in history.events[-1].text
    assert np.isnan(history.measures.rows()[-1, 1])
    history.add_diagnosis(T0 + 2, Diagnosis(1, "", {"images": "3", "last error": "no messages on image"}))
    assert history.events[-1].text == "no messages on image"

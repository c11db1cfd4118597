"""What /diagnostics reports: levels and warnings with their cause, figures of a node at work, and its accounting of CPU time."""

from __future__ import annotations

import logging
import time
from functools import partial
from typing import Any

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from paths import ROOT
from ros_peer import Peer, start_parameters
from sensor_msgs.msg import Image
from vehicle import QUICK

from calib_ros.camera import Camera
from calib_ros.config import Config, OnlineConfig, update
from calib_ros.intrinsics import IntrinsicEstimate, RefinedCamera
from calib_ros.online.events import ExtrinsicUpdated, Inputs
from calib_ros.online.pacing import KEYFRAME_EVERY_S, LoadBudget, Work
from calib_ros.online.pipeline import Pipeline
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.result import BLINDED, CONVERGED, INSUFFICIENT, MOVED, REFUSED, SUSPECT, Extrinsic, Result
from calib_ros.ros import calibration
from calib_ros.ros.diagnostics import Diagnostics, Health, refined_values

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Watched:
    """Diagnostics of a pipeline that nothing is sent to; time is what the test says."""

    def __init__(self) -> None:
        config = Config(online=OnlineConfig(max_load=0.05))
        self.now, self.health = 0.0, Health(logging.getLogger())
        self.pipeline = Pipeline(config, Inputs(*3 * [lambda *_: None]), lambda event: None)
        self.load = self.pipeline.load = LoadBudget(config.online, lambda: self.now)
        self.diagnostics = Diagnostics("/calib_ros", self.health, self.pipeline, lambda: {"more": "yes"})

    def status(self) -> DiagnosticStatus:
        self.diagnostics.check()
        return self.diagnostics.status()


@pytest.fixture
def watched():
    made = Watched()
    yield made
    assert made.pipeline.stop()


@pytest.mark.parametrize(
    ("status", "level", "text"),
    [
        (CONVERGED, OK, "converged"),
        (REFUSED, WARN, "refused: because"),
        (INSUFFICIENT, WARN, "insufficient: because"),
        (SUSPECT, WARN, "suspect: because"),
        (MOVED, ERROR, "moved: because"),
        (BLINDED, ERROR, "blinded: because"),
    ],
)
def test_every_status_has_its_level(watched, status, level, text):
    assert watched.status().message == "collecting keyframes"
    covariance = np.diag([1e-6, 4e-6, 1e-6, 1e-4, 1e-4, 9e-4])
    result = Result(np.eye(4), status, "" if status == CONVERGED else "because", 0.9, covariance)
    watched.health.add(ExtrinsicUpdated(Extrinsic(result, 1.25, 7, "does not fit", 0.031), 0))
    found = watched.status()
    assert (found.level, found.message) == (level, text)
    said = {v.key: v.value for v in found.values}
    assert (said["status"], said["drift"], said["estimates accepted"], said["more"]) == (status, "1.25", "7", "yes")
    assert said["sigma of rotation, deg"] == f"{np.rad2deg(2e-3):.3f}"
    assert said["sigma of translation, m"] == "0.0300"
    assert (said["monitor p-value"], said["monitor"]) == ("0.031", "does not fit")


def test_the_use_of_cpu_time_is_told_by_kinds_of_work(watched, monkeypatch):
    for k, work in enumerate(Work):
        watched.load.add(work, 1.0 * k)
    later = time.monotonic() + 10.0
    monkeypatch.setattr("calib_ros.ros.diagnostics.time.monotonic", lambda: later)
    said = {v.key: v.value for v in watched.status().values}
    share, _, allowed = said["CPU, share of a core"].partition(" of ")
    assert [float(said[f"CPU for {work.value}"]) for work in Work] == pytest.approx([0.1 * k for k in range(len(Work))], rel=0.05)
    assert (float(share), allowed) == (pytest.approx(0.1 * sum(range(len(Work))), rel=0.05), "0.05")


def twice_the_budget(watched: Watched) -> None:
    for _ in range(4):
        watched.now += KEYFRAME_EVERY_S
        watched.load.add(Work.INTAKE, 0.1 * KEYFRAME_EVERY_S)
        assert watched.load.allows_keyframe()


def frames_wait(watched: Watched) -> None:
    for _ in range(100):
        watched.now += 1.0
        if watched.load.allows_keyframe():
            watched.load.add(Work.KEYFRAMES, 0.2)
    assert watched.load.counts().postponed > 50


def motion_unknown(watched: Watched, keyframes: int) -> None:
    watched.pipeline.recalibrator.motion.left_out = keyframes


def pairs_dropped(watched: Watched, computed: float, **online: float) -> None:
    watched.pipeline.config = update(
        watched.pipeline.config, {"online": online or {"max_load": 0.5}, "image": {"max_width": 160}}
    )
    watched.pipeline.pairing.synchronizer.counts.pairs += 20
    watched.pipeline.dropped_pairs += 15
    watched.pipeline._ingester.busy_s += 4.0
    watched.load.add(Work.KEYFRAMES, computed * 4.0)


DROPPED = "75% of the pairs are dropped before they are looked at: "
AT_LIMITS = {"max_load": 0.05, "keyframe_spacing_s": 60.0}


@pytest.mark.parametrize(
    ("happens", "texts"),
    [
        (twice_the_budget, ("online.max_load = 0.05 does not even allow for a keyframe in 5 s", "raise it")),
        (twice_the_budget, ("keyframes beyond online.max_load: 4",)),
        (frames_wait, ()),
        (partial(motion_unknown, keyframes=2), ()),
        (partial(motion_unknown, keyframes=3), ("3 keyframes of the last", "motion from scans: none needed so far")),
        (
            partial(pairs_dropped, computed=1.0),
            (f"{DROPPED}keyframes take all the time; lower online.max_load, or raise online.keyframe_spacing_s\n",),
        ),
        (
            partial(pairs_dropped, computed=0.2),
            (f"{DROPPED}the node gets too little CPU time; give it a core, or lower online.max_load\n",),
        ),
        # What is at the end of its range cannot be lowered or raised.
        (partial(pairs_dropped, computed=1.0, **AT_LIMITS), ("all the time; lower the rate of images and clouds\n",)),
        (partial(pairs_dropped, computed=0.2, **AT_LIMITS), ("too little CPU time; give it a core\n",)),
    ],
)
def test_what_keeps_keyframes_away_is_a_warning_with_cause_and_advice(watched, drive, happens, texts):
    watched.pipeline.recalibrator = Recalibrator(drive.camera, drive.reference, watched.pipeline.config)
    assert watched.status().level == OK
    happens(watched)
    found = watched.status()
    assert found.level == (WARN if texts else OK)
    said = "\n".join([found.message, *(f"{v.key}: {v.value}" for v in found.values)])
    assert all(text in said for text in texts), said


def test_refined_intrinsics_are_told_in_numbers():
    camera = Camera(np.array([[714.0, 0, 630.25], [0, 714, 370], [0, 0, 1]]), 1280, 720, D=np.array([-0.31, 0.1, 0, 0, 0]))
    changes = {
        "focal_length_share": IntrinsicEstimate(0.02, 0.001, True),
        "principal_point_x_px": IntrinsicEstimate(-3.0, 1.5, True),
        "k1": IntrinsicEstimate(0.0, 0.004, False),
    }
    assert refined_values(RefinedCamera(camera, np.eye(4), changes, np.eye(9))) == {
        "refined focal length, px": "714.0 +- 0.7",
        "refined fy against fx, share": "unknown",
        "refined principal point x, px": "630.2 +- 1.5",
        "refined principal point y, px": "unknown",
        "refined k1": "-0.3100 +- 0.0040, hardly shown",
    }
    assert set(refined_values(None).values()) == {"unknown"}


def test_a_node_at_work(street, drive, monkeypatch):
    """An exception in a callback ends neither node nor service."""
    with Peer(**start_parameters(drive.reference), **QUICK, initial_from_tf=False, vehicle="car 7") as peer:

        def broken(*_: Any) -> Any:
            raise ZeroDivisionError("by hand")

        with monkeypatch.context() as patch:
            patch.setattr(peer.pipeline.pairing.synchronizer, "add", broken)
            patch.setattr(peer.calibration.initial, "before_messages", broken)
            peer.image_pub.publish(Image())
            peer.until(lambda: peer.calibration.health.errors == 1)
            assert "unexpected ZeroDivisionError in test_diagnostics.py:" in peer.last_error()
            assert "please report it" in peer.get_extrinsic().message
        peer.publish(street[0])
        assert peer.get_extrinsic().message == "from the parameters"
        peer.drive(street[1:5])
        peer.image_pub.publish(Image())  # that no cloud belongs to
        peer.until(lambda: peer.values.get("images") == "6" and peer.values["estimates accepted"] != "0")
        said, statuses = peer.values, peer.diagnostics[-1].status
        spent = peer.pipeline.load.counts().seconds
    assert min(spent[work] for work in (Work.MESSAGES, Work.INTAKE, Work.KEYFRAMES, Work.ESTIMATES)) > 0
    assert {status.hardware_id for status in statuses} == {"car 7 camera velodyne"}
    groups = yaml.safe_load((ROOT / "config/diagnostic_aggregator.yaml").read_text())["analyzers"]["ros__parameters"]
    patterns = [pattern for group in groups.values() if isinstance(group, dict) for pattern in group["contains"]]
    assert sorted(patterns) == sorted(status.name for status in statuses)
    assert said["status"] == "converged"
    assert (said["clouds"], said["pairs"], said["keyframes so far"]) == ("5", "5", "5")
    assert float(said["age of the last estimate, s"]) >= 0
    assert 0 < float(said["sigma of rotation, deg"]) < 1
    assert 0 < float(said["sigma of translation, m"]) < 0.3
    assert float(said["callback 99th percentile, ms"]) > 0
    assert said["motion from scans"].startswith("failed: the scans are 1 s apart")
    assert said["frames too fast for a keyframe"] == "0"


def test_a_change_of_status_is_diagnosed_at_once(street, drive, monkeypatch):
    monkeypatch.setattr(calibration, "DIAGNOSED_AGAIN_S", 0.0)
    with Peer(**start_parameters(drive.reference), **QUICK, initial_from_tf=False) as peer:
        for timer in peer.calibration._timers:  # nothing else diagnoses it
            timer.cancel()
        peer.drive(street[:5])
        peer.until(lambda: peer.extrinsics and peer.extrinsics[-1].status == "converged", "a converged extrinsic")
        peer.until(lambda: peer.values.get("status") == "converged", "its diagnosis")


def test_topics_on_which_nothing_comes_are_named_with_what_is_known_of_them():
    with Peer() as peer:
        silent = "; ".join(f"/{topic} is published, but nothing comes; check its driver" for topic in ("image", "points"))
        peer.until(lambda: peer.diagnostics and peer.diagnostics[-1].status[0].message == silent, silent)
        assert peer.diagnostics[-1].status[0].level == DiagnosticStatus.STALE

"""online.max_load in a real node: its own accounting on /diagnostics, and the warnings about what keeps keyframes away."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from itertools import count

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from ros_peer import Peer, start_parameters
from vehicle import Vehicle
from waiting import until

from calib_ros.config import Config, OnlineConfig
from calib_ros.frame import Frame
from calib_ros.online.events import Event, Inputs
from calib_ros.online.pacing import KEYFRAME_EVERY_S, SAVED_S, LoadBudget, Work
from calib_ros.online.pipeline import Pipeline
from calib_ros.online.recalibrator import Recalibrator
from calib_ros.ros.conversions import time_message
from calib_ros.ros.diagnostics import Diagnostics, Health
from calib_ros_synthetic.drive import SyntheticDrive

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures("ros_in_this_process")]
MAX_LOAD = 0.3
DRIVE_S, PERIOD_S = 8.0, 0.05  # s after the budget has become tight, and between pairs
# An estimate that nothing was known of before, and a keyframe: by so much the budget may be overdrawn, s of CPU time.
OVERDRAWN_S = 3.0


def test_the_nodes_own_accounting_keeps_to_the_budget(street: list[Frame], drive: SyntheticDrive) -> None:
    """Every frame is to be a keyframe, at 20 Hz: that would take more than a core."""
    wanted = {"keyframe_spacing_s": 0.0, "similarity_threshold": 1.0, "min_keyframes": 3}
    options = {f"online__{name}": value for name, value in wanted.items()}
    with Peer(**start_parameters(drive.reference), online__max_load=MAX_LOAD, search__rotation_deg=0.0, **options) as peer:
        vehicle, pairs = Vehicle(peer, street, drive.reference), count(1)
        now = 0.0  # s; time goes on with the pairs, so that the budget gets tight on a busy machine as well

        def drive_on() -> None:
            nonlocal now
            peer.publish(vehicle.frame(1.0))
            now = next(pairs) * PERIOD_S
            time.sleep(PERIOD_S)

        budget = peer.pipeline.load = LoadBudget(peer.pipeline.config.online, lambda: now)
        until(lambda: budget.counts().postponed > 10, "a tight budget", drive_on)
        began, before = now, budget.counts()
        until(lambda: now - began >= DRIVE_S, "the end of the drive", drive_on)
        took, after = now - began, budget.counts()
        values = peer.new_values()

    used = sum(after.seconds.values()) - sum(before.seconds.values())
    assert used <= MAX_LOAD * took + OVERDRAWN_S
    assert after.postponed > before.postponed
    assert after.keyframes - before.keyframes >= int(took / (KEYFRAME_EVERY_S + 1.0))  # never none
    assert after.seconds[Work.MESSAGES] > before.seconds[Work.MESSAGES] > 0
    share, _, allowed = values["CPU, share of a core"].partition(" of ")
    assert float(allowed) == MAX_LOAD
    parts = [float(values[f"CPU for {work.value}"]) for work in Work]
    assert sum(parts) == pytest.approx(float(share), abs=0.01)
    assert sum(parts) <= MAX_LOAD + (SAVED_S * MAX_LOAD + OVERDRAWN_S) / min(took, 30.0)
    assert int(values["frames that waited for online.max_load"]) >= after.postponed


class Watched:
    """Diagnostics of a pipeline that nothing is sent to; time is what the test says."""

    def __init__(self, max_load: float, drive: SyntheticDrive) -> None:
        config = Config(online=OnlineConfig(max_load=max_load))
        self.now = 0.0
        self.pipeline = Pipeline(config, Inputs(*3 * [lambda *_: None]), self.ignore)
        self.pipeline.load = LoadBudget(config.online, lambda: self.now)
        self.pipeline.recalibrator = Recalibrator(drive.camera, drive.reference, config)
        self.diagnostics = Diagnostics("/calib_ros", Health(logging.getLogger()), self.pipeline)

    def ignore(self, event: Event) -> None: ...

    def status(self) -> DiagnosticStatus:
        return self.diagnostics.message(time_message(0)).status[0]


@pytest.fixture
def starved(drive: SyntheticDrive) -> Iterator[Watched]:
    watched = Watched(0.05, drive)
    yield watched
    assert watched.pipeline.stop()


def test_a_budget_that_allows_for_no_keyframe_is_a_warning(starved: Watched) -> None:
    load = starved.pipeline.load
    assert starved.status().level == DiagnosticStatus.OK
    for _ in range(4):
        starved.now += KEYFRAME_EVERY_S
        load.add(Work.INTAKE, 0.1 * KEYFRAME_EVERY_S)  # twice the budget
        assert load.allows_keyframe()
    found = starved.status()
    assert found.level == DiagnosticStatus.WARN
    assert "online.max_load = 0.05 does not even allow for a keyframe in 5 s" in found.message
    assert "raise it" in found.message
    assert {v.key: v.value for v in found.values}["keyframes beyond online.max_load"] == "4"


def test_a_budget_that_makes_frames_wait_is_none(starved: Watched) -> None:
    starved.status()
    for _ in range(100):
        starved.now += 1.0
        if starved.pipeline.load.allows_keyframe():
            starved.pipeline.load.add(Work.KEYFRAMES, 0.2)
    assert starved.pipeline.load.counts().postponed > 50
    assert starved.status().level == DiagnosticStatus.OK


def test_keyframes_of_unknown_motion_are_a_warning_with_its_reason(starved: Watched) -> None:
    motion = starved.pipeline.recalibrator.motion
    assert starved.status().level == DiagnosticStatus.OK
    motion.left_out = 2
    assert starved.status().level == DiagnosticStatus.OK
    motion.left_out = 3
    found = starved.status()
    assert found.level == DiagnosticStatus.WARN
    assert "3 keyframes of the last" in found.message
    assert "motion from scans: none needed so far" in found.message


@pytest.mark.parametrize(
    ("computed", "cause"), [(1.0, "keyframes take all the time"), (0.2, "the node gets too little CPU time")]
)
def test_dropped_pairs_are_a_warning_with_their_cause(drive: SyntheticDrive, computed: float, cause: str) -> None:
    watched = Watched(0.5, drive)
    pipeline = watched.pipeline
    try:
        watched.status()
        pipeline.synchronizer.counts.pairs += 20
        pipeline._ingester.dropped += 15
        pipeline._ingester.busy_s += 4.0
        pipeline.load.add(Work.KEYFRAMES, computed * 4.0)
        found = watched.status()
    finally:
        assert pipeline.stop()
    assert found.level == DiagnosticStatus.WARN
    assert "75% of the pairs are dropped" in found.message
    assert cause in found.message
    assert "lower online.max_load" in found.message

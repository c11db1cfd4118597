"""The budget of CPU time, with a clock and costs that the tests set."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros.config import OnlineConfig
from calib_ros.online.pacing import CLASSES_EVERY_S, ESTIMATE_EVERY_S, KEYFRAME_EVERY_S, SAVED_S, LoadBudget, Work, is_due

INTAKE, KEYFRAME, ESTIMATE = 0.005, 0.22, 0.4  # s of CPU time; as on KITTI
STEP = 0.1  # s between pairs


class Vehicle:
    """A budget on a clock of its own, and pairs at 10 Hz that could all be keyframes."""

    def __init__(self, max_load: float, estimates_due: bool = True) -> None:
        self.now = 1000.0
        self.budget = LoadBudget(OnlineConfig(max_load=max_load), lambda: self.now)
        self.due = estimates_due
        self.keyframes: list[float] = []
        self.estimates: list[float] = []

    def drive(self, seconds: float) -> float:
        """CPU time that was used meanwhile, as a share of a core."""
        before, end = self.used(), self.now + seconds
        while self.now < end - STEP / 2:
            self.now += STEP
            self.budget.add(Work.INTAKE, INTAKE)
            if self.budget.allows_keyframe():
                self.keyframes.append(self.now)
                self.budget.add(Work.KEYFRAMES, KEYFRAME)
            if self.budget.allows_estimate(self.due):
                self.estimates.append(self.now)
                self.budget.start_estimate()
                self.budget.add(Work.ESTIMATES, ESTIMATE)
        return (self.used() - before) / seconds

    def used(self) -> float:
        return sum(self.budget.counts().seconds.values())

    def spend(self, seconds: float, work: Work = Work.KEYFRAMES) -> None:
        self.budget.add(work, seconds)

    def keyframe_after(self, seconds: float) -> bool:
        """May a keyframe be taken when so much time has passed?"""
        self.now += seconds
        return self.budget.allows_keyframe()


@pytest.mark.parametrize("max_load", [0.2, 0.3, 0.5, 1.0])
def test_all_work_together_keeps_to_the_share(max_load: float) -> None:
    vehicle = Vehicle(max_load)
    first = vehicle.drive(60)
    assert max_load < first <= max_load * (1 + SAVED_S / 60) + ESTIMATE / 60
    assert vehicle.drive(60) == pytest.approx(max_load, rel=0.05)
    assert vehicle.budget.counts().forced == 0


def test_keyframes_and_estimates_that_wait_take_turns() -> None:
    vehicle = Vehicle(0.3)
    vehicle.drive(20)
    before = vehicle.budget.counts().seconds
    vehicle.drive(100)
    after = vehicle.budget.counts().seconds
    assert after[Work.KEYFRAMES] - before[Work.KEYFRAMES] == pytest.approx(
        after[Work.ESTIMATES] - before[Work.ESTIMATES], rel=0.3
    )


def test_where_no_estimate_is_due_keyframes_have_all() -> None:
    vehicle = Vehicle(0.3, estimates_due=False)
    vehicle.drive(20)
    n = len(vehicle.keyframes)
    vehicle.drive(60)
    assert len(vehicle.keyframes) - n == pytest.approx(60 * (0.3 - INTAKE / STEP) / KEYFRAME, abs=2)


@pytest.mark.parametrize(("saved_s", "overdrawn", "wait"), [(3600.0, 0.01, 0.02), (0.0, 1.0, 2.0)])
def test_the_budget_saves_up_for_some_seconds_only_and_what_is_overdrawn_is_made_up_for(
    saved_s: float, overdrawn: float, wait: float
) -> None:
    vehicle = Vehicle(0.5)
    assert vehicle.keyframe_after(saved_s)
    vehicle.spend(0.5 * SAVED_S)
    assert vehicle.keyframe_after(0.0)
    vehicle.spend(overdrawn)
    assert not vehicle.keyframe_after(0.95 * wait)
    assert vehicle.keyframe_after(0.1 * wait)
    assert vehicle.budget.counts().forced == 0


def test_however_overdrawn_a_keyframe_is_taken_now_and_then_and_an_estimate_made() -> None:
    vehicle = Vehicle(0.05)
    vehicle.drive(1)
    vehicle.spend(1e6, Work.ESTIMATES)
    vehicle.keyframes, vehicle.estimates = [], []
    vehicle.drive(120)
    gaps = [b - a for a, b in zip(vehicle.keyframes, vehicle.keyframes[1:], strict=False)]
    assert len(gaps) == pytest.approx(120 / KEYFRAME_EVERY_S, abs=2)
    assert min(gaps) >= KEYFRAME_EVERY_S - 1e-6
    assert max(gaps) <= KEYFRAME_EVERY_S + 2 * STEP
    assert len(vehicle.estimates) == pytest.approx(120 / ESTIMATE_EVERY_S, abs=1)
    assert vehicle.budget.counts().forced == len(vehicle.keyframes)
    assert vehicle.budget.counts().postponed > 1000


def test_classes_are_the_first_to_go_without() -> None:
    vehicle = Vehicle(0.5)
    assert vehicle.budget.allows_classes()
    vehicle.spend(0.6 * SAVED_S * 0.5)
    assert not vehicle.budget.allows_classes()
    assert vehicle.budget.allows_classes(needed=True)  # nothing would ever be estimated
    assert vehicle.budget.allows_keyframe()
    assert vehicle.budget.allows_estimate(True)
    vehicle.spend(1e6, Work.ESTIMATES)
    for wait, allowed in ((CLASSES_EVERY_S - 0.1, False), (0.2, True)):
        vehicle.now += wait
        assert vehicle.budget.allows_classes() is allowed


@pytest.mark.parametrize("in_step", [True, False])
def test_what_is_done_in_step_falls_on_the_same_stamps_wherever_it_began(in_step: bool) -> None:
    """Scans at 10 Hz with jitter, every 0.55 s."""
    rng, every_s = np.random.default_rng(0), 0.55
    stamps = np.sort(10**18 + np.arange(200) * 100_000_000 + rng.integers(-9_000_000, 9_000_000, 200)).tolist()
    chosen = []
    for first in (0, 2, 3):
        last, done = stamps[first], []
        for stamp in stamps[first + 1 :]:
            if is_due(last, stamp, every_s, in_step):
                last = stamp
                done.append(stamp)
        gaps = np.diff(done) / 1e9
        assert 0.4 < gaps.min() < gaps.max() < 0.8
        chosen.append(done)
    late = [[stamp for stamp in done if stamp > stamps[20]] for done in chosen]
    assert (late[0] == late[1] == late[2]) == in_step
    assert is_due(stamps[9], stamps[3], every_s, in_step)  # the clock was set back
    assert is_due(None, stamps[0], every_s, in_step)

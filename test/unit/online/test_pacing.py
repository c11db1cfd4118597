"""The budget of CPU time, with a clock and costs that the tests set; and when estimates run under it, by the modes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from driven import Driven, config

from calib_ros.config import OnlineConfig
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online.pacing import (
    CLASSES_EVERY_S,
    ESTIMATE_EVERY_S,
    KEYFRAME_EVERY_S,
    SAVED_S,
    LoadBudget,
    Purse,
    Schedule,
    Work,
    is_due,
)
from calib_ros_synthetic.drive import SyntheticDrive

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


def test_a_request_comes_on_top() -> None:
    budget = Vehicle(0.1).budget
    budget.add(Work.ESTIMATES, 1e6, charged=False)
    assert budget.allows_keyframe()
    assert budget.counts().forced == 0


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


def test_pairs_spend_one_budget_and_have_their_least_of_keyframes_each() -> None:
    now = [0.0]
    config = OnlineConfig(max_load=0.5)
    purse = Purse(config, lambda: now[0])
    first, second = (LoadBudget(config, purse=purse) for _ in range(2))
    first.add(Work.KEYFRAMES, 2 * SAVED_S * config.max_load)
    assert second.allows_keyframe()  # the first one in so many seconds, beyond the budget
    assert not second.allows_keyframe()
    assert second.counts().forced == 1
    now[0] += 2 * SAVED_S
    assert second.allows_keyframe()
    assert second.counts().forced == 1


def seconds(s: float) -> int:
    return round(s * NANOSECONDS)


def moments(schedule: Schedule, *times: float, waits: bool = False) -> list[bool]:
    """Whether an estimate is due at each of these times, s; where it is, it begins."""
    out = []
    for t in times:
        schedule.add_frame(seconds(t))
        out.append(schedule.due(waits=waits))
        if out[-1]:
            schedule.start_estimate()
    return out


@pytest.mark.parametrize(("mode", "due"), [("continuous", True), ("manual", False)])
def test_continuous_mode_is_always_due_and_manual_never(mode: str, due: bool) -> None:
    assert moments(Schedule(OnlineConfig(mode=mode)), 0.0, 1.0, 1000.0, 0.5) == [due] * 4


@pytest.mark.parametrize(
    ("config", "waits"),
    [(OnlineConfig(mode="periodic", period_s=10.0), False), (OnlineConfig(rest_period_s=10.0), True)],
    ids=["periodic", "rest"],
)
def test_periods_count_the_datas_own_stamps(config: OnlineConfig, waits: bool) -> None:
    schedule = Schedule(config)
    assert schedule.due(waits=waits)
    assert moments(schedule, 100.0, 109.9, 110.0, 119.9, 500.0, waits=waits) == [True, False, True, False, True]
    assert moments(schedule, 20.0, 20.0, waits=waits) == [True, False]  # a looping bag begins anew
    schedule.add_frame(seconds(28))
    schedule.start_estimate()  # as a request does: it starts the period anew
    assert moments(schedule, 32.0, 38.0, waits=waits) == [False, True]


def test_the_pipeline_in_manual_mode_waits_for_the_service(street: list[Frame], drive: SyntheticDrive) -> None:
    with Driven(drive, config(mode="manual")) as driven:
        driven.feed(*street[:5])
        assert driven.estimates == 0
        assert driven.kept == [frame.stamp for frame in street[:5]]
        assert driven.pipeline.request_estimate().result(60).result.converged
        assert driven.estimates == 1
        # From here on it goes by itself: the change takes effect with the next frame.
        driven.pipeline.configure(config(mode="continuous"))
        driven.feed(street[5])
        assert (driven.estimates, driven.errors) == (2, [])


def test_an_overdrawn_budget_delays_all_but_requested_estimates(street: list[Frame], drive: SyntheticDrive) -> None:
    with Driven(drive, config(max_load=0.05)) as driven:
        driven.feed(*street[:2])
        assert driven.estimates == 1
        driven.pipeline.load.add(Work.ESTIMATES, 1e9)  # as after one that took very long
        driven.feed(*street[2:5])
        assert (driven.estimates, len(driven.kept), driven.pipeline.load.counts().postponed) == (1, 2, 3)
        assert driven.pipeline.request_estimate().result(60).result.converged
        assert driven.estimates == 2


def test_cpu_time_is_booked_under_the_work_it_went_into(street: list[Frame], drive: SyntheticDrive) -> None:
    with Driven(drive, config(mode="manual")) as driven:
        driven.feed(street[0])
        once = driven.pipeline.load.counts().seconds
        soon = dataclasses.replace(street[0], stamp=street[0].stamp + seconds(0.01), cloud_stamp=None)
        driven.feed(soon)  # too soon for a keyframe
        twice = driven.pipeline.load.counts().seconds
        assert once[Work.KEYFRAMES] > once[Work.INTAKE] > 0
        assert twice[Work.INTAKE] > once[Work.INTAKE]
        assert twice[Work.KEYFRAMES] == once[Work.KEYFRAMES]
        assert twice[Work.ESTIMATES] == twice[Work.CLASSES] == twice[Work.MESSAGES] == 0
        driven.feed(street[1])
        assert driven.pipeline.request_estimate().result(60).result.converged
        assert driven.pipeline.load.counts().seconds[Work.ESTIMATES] > 0

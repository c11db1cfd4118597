"""When estimates run: modes over the data's stamps, and the pipeline under them and the budget of CPU time."""

from __future__ import annotations

import dataclasses

import pytest
from driven import Driven, config

from calib_ros.config import OnlineConfig
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online.pacing import Schedule, Work
from calib_ros_synthetic.drive import SyntheticDrive


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

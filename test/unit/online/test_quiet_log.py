"""Lines in the log: one of a kind in 10 s, and nothing lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from driven import Driven, config

from calib_ros.frame import Frame, PointCloud
from calib_ros.online.events import QuietLog
from calib_ros_synthetic.drive import SyntheticDrive


def test_what_differs_in_its_figures_alone_is_one_line_in_ten_seconds_and_counted() -> None:
    now, lines = [0.0], list[str]()
    log = QuietLog(lambda: now[0])
    for tenth in range(250):
        now[0] = tenth / 10
        log.add("cloud", f"{tenth} points", lines.append)
        if tenth in (3, 4):
            log.add("camera", "no image", lines.append)
        log.catch_up()
    assert lines == ["0 points", "no image", "100 points (99 more in 10 s)", "no image", "200 points (99 more in 10 s)"]
    for now[0] in (29.0, 30.0, 60.0):  # what came last is told although nothing comes any more
        log.catch_up()
    assert lines[5:] == ["249 points (48 more in 10 s)"]


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

"""Reasons say what is meant, also where a figure is zero, infinite or none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calib_ros.camera import Camera
from calib_ros.errors import defect
from calib_ros.intrinsics import ASPECT, CENTRE, FOCAL, RADIAL
from calib_ros.online.sensor_health import SensorFault
from calib_ros.registration.judgement.refusal import left_open, lines_of, odd_intrinsics, refused, wrong_intrinsics, wrong_times
from calib_ros.result import Cause, RefusalCode, Trouble

CAMERA = Camera(np.diag([700.0, 700.0, 1.0]), 1000, 500)
LENS = {FOCAL: 0.0, ASPECT: 0.0, CENTRE[0]: 0.0, CENTRE[1]: 0.0, RADIAL: 0.0}
LENSES = [
    (CENTRE[0], 0.00042, False, "about 0.42 px further to the right"),
    (ASPECT, -0.03, False, "with fy about 3.0% shorter against fx"),
    (RADIAL, 0.1, True, "as if the images were rectified already (3.6 standard deviations)"),
    (RADIAL, -0.05, False, "that camera_info does not state, which moves the corners by -5.0%"),
]


@pytest.mark.parametrize(
    ("said", "text"),
    [
        (wrong_times(-0.6, 0.0), "the clocks 600 ms apart, which the scenes do not confirm: images"),
        (refused(RefusalCode.LOW_SCORE, score=math.nan), "nothing in the image where the LiDAR sees edges: check"),
        (left_open("time_offset_s", 0.0, math.inf, 0.13, 0.25, 0.05), "the scenes do not show time_offset_s, and leave open"),
        *((wrong_intrinsics(main, LENS | {main: value}, CAMERA, gone, 3.6), text) for main, value, gone, text in LENSES),
        (defect(AssertionError()), "unexpected AssertionError; please report it"),
    ],
)
def test_reasons_without_riddles(said: object, text: str) -> None:
    assert text in str(said)


@pytest.mark.parametrize("wrong", [*RefusalCode, *Cause, *SensorFault])
def test_what_is_wrong_and_what_to_do_are_a_line(wrong: Trouble) -> None:
    assert len(f"insufficient: {wrong}") <= 100
    assert lines_of(f"{wrong}; z-score 3") == [str(wrong), "z-score 3"]


@pytest.mark.parametrize(("fy", "cx", "says"), [(734, 350, []), (740, 350, ["differ by 6%"]), (700, 180, ["at 18% of"])])
def test_odd_intrinsics_are_told(fy: float, cx: float, says: list[str]) -> None:
    told = odd_intrinsics(Camera(np.array([[700.0, 0, cx], [0, fy, 250], [0, 0, 1]]), 1000, 500))
    assert [text in line for text, line in zip(says, told, strict=True)] == [True] * len(says)

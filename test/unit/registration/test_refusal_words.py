"""Reasons say what is meant, also where a figure is zero, infinite or none."""

from __future__ import annotations

import math

import pytest

from calib_ros.errors import defect
from calib_ros.registration.acceptance.refusal import left_open, low_score, wrong_intrinsics, wrong_times


@pytest.mark.parametrize(
    ("said", "text"),
    [
        (wrong_times(-0.6, 0.0), "the clocks set 600 ms apart, which the scenes do not confirm: images"),
        (low_score(math.nan), "the image shows nothing where the LiDAR sees edges; check"),
        (left_open("time_offset_s", 0.0, math.inf, 0.13, 0.25, 0.05), "the scenes do not show time_offset_s, and leave open"),
        (wrong_intrinsics(0.0, 0.42, 0.0, 3.6), "about 0.42 px further to the right"),
        (defect(AssertionError()), "unexpected AssertionError; please report it"),
    ],
)
def test_reasons_without_riddles(said: object, text: str) -> None:
    assert text in str(said)

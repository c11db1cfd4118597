"""Moving an extrinsic by hand."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.registration.initial_guess import nominal
from calib_ros_view.session.numbers import AXES, moved, offsets, step_of

START = se3.perturb(nominal(), [3, -2, 1], [0.2, -0.1, 0.4])
CAMERA = Camera(np.array([[400.0, 0, 320], [0, 400.0, 120], [0, 0, 1]]), 640, 240)


def test_the_six_numbers_of_a_moved_extrinsic_are_those_it_was_moved_by():
    for values in np.random.default_rng(0).uniform(-30, 30, (20, 6)):
        assert offsets(START, moved(START, values)) == pytest.approx(values, abs=1e-9)
    assert np.allclose(moved(START, np.zeros(6)), START)


@pytest.mark.parametrize(("number", "way"), [(0, (0, -1)), (1, (1, 0)), (3, (1, 0)), (4, (0, 1))])
def test_points_move_in_the_picture_as_the_axes_say(number, way):
    """Arrows move the cloud: right and up."""
    point = np.array([[10.0, -0.2, 0.1]])
    values = np.zeros(6)
    values[number] = 1.0
    before, after = (CAMERA.project(se3.transform(T, point))[0][0] for T in (nominal(), moved(nominal(), values)))
    assert np.sign(np.round(after - before, 3)) @ way > 0
    assert abs((after - before) @ way) > abs((after - before) @ way[::-1])


def test_a_rotation_leaves_the_camera_where_it_is():
    values = np.array([4.0, -3.0, 2.0, 0, 0, 0])
    assert se3.inverse(moved(START, values))[:3, 3] == pytest.approx(se3.inverse(START)[:3, 3])


def test_every_axis_has_two_keys_of_its_own_and_shift_goes_farther():
    keys = [key for axis in AXES for key in axis.keys]
    assert len(set(keys)) == 12
    assert step_of("ArrowRight", False) == (1, 0.05)
    assert step_of("ArrowLeft", True) == (1, -0.5)
    assert step_of("a", False) == (3, 1.0)
    assert step_of("D", True) == (3, -10.0)  # shift makes letters capital
    assert step_of("F1", False) is None

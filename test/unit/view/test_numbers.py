"""Numbers beside the picture: scores around an extrinsic, what the scenes know, and moving an extrinsic by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.registration.initial_guess import nominal
from calib_ros_view.session.numbers import AXES, PAIRS, FrameScores, ellipse, moved, offsets, step_of

OFF = np.r_[np.deg2rad([0.3, -0.4, 0.5]), 0.05, -0.04, 0.1]


@pytest.fixture(scope="module")
def scores(street):
    return FrameScores(street, street[0].camera)


@pytest.fixture(scope="module")
def truth(street):
    return street[0].reference


def peaks(numbers):
    """Offset (6,) at which each curve is highest, deg and cm."""
    return numbers.offsets[np.arange(6), np.argmax(numbers.curves, axis=1)]


def test_curves_are_highest_at_the_right_extrinsic(scores, truth):
    numbers = scores.at(truth)
    assert np.abs(peaks(numbers)[:3]).max() <= 0.1
    assert np.abs(peaks(numbers)[3:]).max() <= 6.0
    assert numbers.curves[:, 20] == pytest.approx(numbers.score)
    assert np.isfinite(numbers.frame_scores).all()
    turned = scores.at(se3.exp(np.r_[0, np.deg2rad(1.0), 0, 0, 0, 0]) @ truth)  # its curve tells which way to go
    assert peaks(turned)[1] == pytest.approx(-1.0, abs=0.15)
    assert turned.score < numbers.score


def test_the_optimum_near_an_extrinsic_and_its_covariance(scores, truth):
    start = se3.exp(OFF) @ truth
    known = scores.known(start)
    assert known.offset == pytest.approx(se3.log(known.T @ se3.inverse(start)))
    error = se3.log(known.T @ se3.inverse(truth))
    assert np.rad2deg(np.abs(error[:3])).max() < 0.15
    assert np.abs(error[3:]).max() < 0.06
    assert error @ np.linalg.solve(known.covariance, error) < 25
    assert [line.split()[0] for line in known.words()] == ["pitch", "yaw", "roll", "sideways", "height", "forward"]


def test_frames_that_are_left_out_do_not_count(scores, truth):
    some = scores.at(truth, left_out={0, 3})
    assert np.flatnonzero(np.isnan(some.frame_scores)).tolist() == [0, 3]
    rest = scores.at(truth)
    assert some.frame_scores[[1, 2, 4]] == pytest.approx(rest.frame_scores[[1, 2, 4]], rel=1e-4)
    assert some.score != rest.score
    with pytest.raises(TooFewFeaturesError, match="left out"):
        scores.at(truth, left_out=range(8))


def test_a_frame_that_cannot_be_used_keeps_its_place(street, truth):
    blind = replace(street[1], image=np.zeros_like(street[1].image))
    empty = replace(street[1], cloud=street[1].cloud.select(np.zeros(len(street[1].cloud), bool)))
    made = FrameScores([street[0], empty, street[2]], street[0].camera)
    assert np.flatnonzero(np.isnan(made.at(truth).frame_scores)).tolist() == [1]
    assert made.notes
    with pytest.raises(BadInputError, match="no frames"):
        FrameScores([], street[0].camera)
    with pytest.raises(BadInputError, match="no frame can be used"):
        FrameScores([empty], blind.camera)


def test_ellipses_hold_the_stated_share():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((6, 6)) * np.r_[np.deg2rad([0.1] * 3), [0.02] * 3][:, None]
    drawn = rng.multivariate_normal(np.zeros(6), A @ A.T, 20_000) * np.r_[[180 / np.pi] * 3, [100.0] * 3]
    for pair in PAIRS:
        border = ellipse(A @ A.T, pair)
        angle = np.arctan2(*border.T[::-1])
        order = np.argsort(angle)
        at = np.arctan2(drawn[:, pair[1]], drawn[:, pair[0]])
        radius = np.interp(at, angle[order], np.hypot(*border[order].T), period=2 * np.pi)
        inside = np.hypot(drawn[:, pair[0]], drawn[:, pair[1]]) < radius
        assert inside.mean() == pytest.approx(0.95, abs=0.02)


# --- moved by hand ---------------------------------------------------------------------------------------------------------


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

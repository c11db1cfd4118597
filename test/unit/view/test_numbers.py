"""Numbers beside the picture: scores around an extrinsic, and what the scenes know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib_ros import se3
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros_view.session.numbers import PAIRS, FrameScores, ellipse

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

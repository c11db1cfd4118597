"""The cloud in the colours of the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib_ros.camera import Camera
from calib_ros.frame import Frame, PointCloud
from calib_ros.registration.initial_guess import nominal
from calib_ros_view.session.picture import UNSEEN, colored_cloud

CAMERA = Camera(np.array([[300.0, 0, 160], [0, 300.0, 100], [0, 0, 1]]), 320, 200)


def picture() -> np.ndarray:
    """Red on the left, blue on the right (BGR)."""
    image = np.zeros((200, 320, 3), np.uint8)
    image[:, :160, 2] = 255
    image[:, 160:, 0] = 255
    return image


def frame(*points: tuple[float, float, float]) -> Frame:
    return Frame(picture(), PointCloud(np.array(points, np.float32)), CAMERA)


def test_points_take_the_colour_under_them():
    _, rgb, seen = colored_cloud(frame((10, 2, 0), (10, -2, 0), (-10, 0, 0)), nominal())
    assert rgb.tolist() == [[255, 0, 0], [0, 0, 255], list(UNSEEN)]
    assert seen.tolist() == [True, True, False]
    near, behind, beside = (5.0, 1.0, 0.0), (20.0, 4.0, 0.0), (20.0, -4.0, 0.0)
    assert colored_cloud(frame(near, behind, beside), nominal())[2].tolist() == [True, False, True]


def test_grey_pictures_and_lost_returns():
    one = frame((10, 2, 0), (np.nan, 0, 0), (0, 0, 0))
    _, rgb, _ = colored_cloud(replace(one, image=one.image[..., 2]), nominal())
    assert rgb.tolist() == [[255, 255, 255]]
    empty = replace(one, cloud=PointCloud(np.zeros((0, 3), np.float32)))
    assert len(colored_cloud(empty, nominal())[0]) == 0


def test_of_many_points_those_in_view_are_kept_and_the_same_every_time(street):
    T = street[0].reference
    xyz, _, seen = colored_cloud(street[0], T, most=10**9)
    assert len(xyz) == len(street[0].cloud.finite())
    most = int(seen.sum()) + 500
    some, _, some_seen = colored_cloud(street[0], T, most)
    assert len(some) == most
    assert some_seen.sum() == seen.sum()
    assert np.array_equal(some, colored_cloud(street[0], T, most)[0])
    assert colored_cloud(street[0], T, 300)[2].all()

"""The picture with the cloud over it, and the cloud in the colours of the picture."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image, ImageSequence

from calib_ros import Config, result, se3
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud
from calib_ros.lidar.edges import EdgeKind, EdgePoints
from calib_ros.registration.initial_guess import nominal
from calib_ros_view.session.film import LOOK, STEPS, film
from calib_ros_view.session.picture import COLORINGS, GAP, KINDS, UNSEEN, FramePicture, Look, colored_cloud, encoded

CAMERA = Camera(np.array([[100.0, 0, 100], [0, 100.0, 50], [0, 0, 1]]), 200, 100)
GRAY = np.full((100, 200, 3), 100, np.uint8)
OPAQUE = Look(width=200, size=1, opacity=1.0)


def frame(*points, camera=CAMERA, **fields):
    xyz = np.array(points, np.float32).reshape(-1, 3)
    return Frame(GRAY, PointCloud(xyz, **{name: np.array(values) for name, values in fields.items()}), camera)


def drawn(picture):
    """Pixels (v, u) that differ from the image."""
    base = np.median(picture.reshape(-1, 3), axis=0)
    return {(int(v), int(u)) for v, u in np.argwhere((picture != base).any(axis=2))}


def test_points_lie_where_the_camera_sees_them():
    assert drawn(FramePicture(frame((10, 0, 0))).draw(nominal(), None, OPAQUE)) == {(50, 100)}
    assert drawn(FramePicture(frame((10, 2, 1))).draw(nominal(), None, OPAQUE)) == {(40, 80)}
    assert not drawn(FramePicture(frame((-10, 0, 0), (10, 50, 0), (np.nan, 0, 0))).draw(nominal(), None, OPAQUE))
    jpeg = encoded(FramePicture(frame((10, 0, 0))).draw(nominal(), None, OPAQUE))
    assert cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).shape == (100, 200, 3)


def test_a_lens_with_distortion_is_drawn_as_it_was_recorded():
    lens = Camera(CAMERA.K, 200, 100, D=np.array([-0.3, 0.08, 0, 0, 0.0]))
    (pixel,) = drawn(FramePicture(frame((10, 5, 2), camera=lens)).draw(nominal(), None, OPAQUE))
    u, v = lens.project([[-5, -2, 10]])[0][0]
    assert pixel == (round(v), round(u))
    assert pixel != (30, 50)


def test_a_window_is_drawn_at_the_full_resolution_of_the_picture():
    look = Look(width=200, size=1, opacity=1.0, window=(0.45, 0.45, 0.55, 0.55))
    assert drawn(FramePicture(frame((50, 0.25, 0))).draw(nominal(), None, look)) == {(50, 95)}  # half a pixel, ten times as large


def test_near_points_cover_far_ones_and_ranges_leave_out():
    both = FramePicture(frame((5, 0, 0), (50, 0, 0)))
    near, far = FramePicture(frame((5, 0, 0))), FramePicture(frame((50, 0, 0)))
    assert (both.draw(nominal(), None, OPAQUE) == near.draw(nominal(), None, OPAQUE)).all()
    beyond = Look(width=200, size=1, opacity=1.0, near=10)
    assert (both.draw(nominal(), None, beyond) == far.draw(nominal(), None, beyond)).all()


def test_colours_follow_what_is_chosen():
    points = [(10, 3, 0), (10, -3, 0)]
    own = FramePicture(
        frame(*points, intensity=np.float32([0, 1]), ring=np.int32([3, 4]), label=np.uint8([1, 5])),
        EdgePoints(np.float32([[10, 0, 0]]), np.ones(1, np.float32), np.array([EdgeKind.REFLECTIVITY], np.uint8)),
    )
    seen = {}
    for name in COLORINGS:
        picture = own.draw(nominal(), None, Look(width=200, size=1, opacity=1.0, coloring=name))
        seen[name] = tuple(picture[50, 70]), tuple(picture[50, 130])
    assert seen["depth"][0] == seen["depth"][1]
    assert all(seen[name][0] != seen[name][1] for name in ("reflectivity", "ring", "class"))
    assert seen["edge kind"][0] == seen["edge kind"][1], "no edges, of no kind"
    for look in (Look(width=200, size=1, coloring="edge kind"), Look(width=200, size=1, cloud=False, edges=True)):
        assert tuple(own.draw(nominal(), None, look)[50, 100]) == KINDS[EdgeKind.REFLECTIVITY][0]


def test_before_and_now():
    own, before = FramePicture(frame((10, 0, 0))), nominal()
    now = before.copy()
    now[0, 3] = 2.0
    both = own.draw(now, before, Look(width=200, size=1, comparison="side by side"))
    assert both.shape == (100 + GAP + 100, 200, 3)
    assert (both[:100] == own.draw(before, None, Look(width=200, size=1))).all()
    blended = own.draw(now, before, Look(width=200, size=1, opacity=1, comparison="blended"))
    assert drawn(blended) == {(50, 100), (50, 120)}
    tall = Camera(np.array([[100.0, 0, 50], [0, 100.0, 100], [0, 0, 1]]), 100, 200)
    upright = FramePicture(Frame(np.ascontiguousarray(GRAY.transpose(1, 0, 2)), PointCloud(np.zeros((0, 3), np.float32)), tall))
    assert upright.draw(now, before, Look(width=100, comparison="side by side")).shape == (200, 200 + GAP, 3)


@pytest.mark.parametrize("wrong", [{"window": (0.5, 0, 0.4, 1)}, {"coloring": "taste"}, {"width": 10**6}, {"near": 5, "far": 4}])
def test_looks_out_of_range_are_refused(wrong):
    with pytest.raises(BadInputError):
        Look(**wrong)


def test_a_film_swings_from_wrong_to_right_and_is_small_enough(drive, street, tmp_path, monkeypatch):
    monkeypatch.setattr("calib_ros_view.session.film.MOST_BYTES", 90_000)
    poses = se3.perturb(drive.reference, [1, -1, 1], [0.1, 0, 0]), drive.reference, drive.reference
    path = tmp_path / "drive.gif"
    film(path)([(k, result.Extrinsic(result.Result(T, result.CONVERGED))) for k, T in enumerate(poses)], drive, Config())
    assert path.stat().st_size <= 90_000
    pictures = [np.array(own.convert("RGB"))[..., ::-1] for own in ImageSequence.Iterator(Image.open(path))]
    assert len(pictures) == 3 + STEPS
    for shown, right in ((pictures[1], 0), (pictures[1 + STEPS], 1)):
        drawn = [FramePicture(street[1]).draw(T, None, replace(LOOK, width=shown.shape[1])) for T in poses[:2]]
        off = [cv2.absdiff(own, np.ascontiguousarray(shown[: len(own)])).mean() for own in drawn]
        assert off[right] < 0.95 * off[1 - right]


# --- the cloud in the colours of the picture ------------------------------------------------------------------------------


def red_and_blue(*points):
    """A frame whose picture is red on the left, blue on the right (BGR)."""
    image = np.zeros_like(GRAY)
    image[:, :100, 2] = image[:, 100:, 0] = 255
    return replace(frame(*points), image=image)


def test_points_take_the_colour_under_them():
    _, rgb, seen = colored_cloud(red_and_blue((10, 2, 0), (10, -2, 0), (-10, 0, 0)), nominal())
    assert rgb.tolist() == [[255, 0, 0], [0, 0, 255], list(UNSEEN)]
    assert seen.tolist() == [True, True, False]
    near, behind, beside = (5.0, 1.0, 0.0), (20.0, 4.0, 0.0), (20.0, -4.0, 0.0)
    assert colored_cloud(red_and_blue(near, behind, beside), nominal())[2].tolist() == [True, False, True]


def test_grey_pictures_and_lost_returns():
    one = red_and_blue((10, 2, 0), (np.nan, 0, 0), (0, 0, 0))
    _, rgb, _ = colored_cloud(replace(one, image=one.image[..., 2]), nominal())
    assert rgb.tolist() == [[255, 255, 255]]
    assert len(colored_cloud(frame(), nominal())[0]) == 0


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

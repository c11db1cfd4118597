"""Projection and rectification against OpenCV and against each other."""

from __future__ import annotations

import numpy as np
import pytest

from calib_ros.camera import SPHERE, Camera, Rectifier
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud
from calib_ros.registration.features import working_camera

K = np.array([[410.0, 0, 322.3], [0, 405.0, 241.7], [0, 0, 1]])
LENSES = {
    "plumb_bob": [-0.28, 0.07, 1e-3, -2e-3, 0.005],
    "plumb_bob of 4": [-0.28, 0.07, 1e-3, -2e-3],
    "rational_polynomial": [0.6, 0.1, 1e-4, -2e-4, 0.01, 0.9, 0.2, 0.02],
    "equidistant": [0.02, -0.01, 0.003, -0.001],
}
BARREL = [-0.3, 0.1, 0, 0, -0.0125]  # of a wide lens whose picture corners show nothing


def camera(name: str) -> Camera:
    return Camera(K, 640, 480, name.split()[0], np.array(LENSES[name]))


def rays(n: int = 500, width: float = 0.8) -> np.ndarray:
    """(n, 3) points in front of the camera, most of them in its picture."""
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.5, 60, n)
    return np.c_[rng.uniform(-width, width, n) * depth, rng.uniform(-0.6, 0.6, n) * depth, depth]


def test_a_pinhole_divides_by_the_depth():
    uv, inside = Camera(K, 640, 480).project([[1.0, -2.0, 4.0], [0.0, 0.0, 1.0], [10.0, 0.0, 1.0]])
    assert np.allclose(uv, [[410 / 4 + 322.3, -405 / 2 + 241.7], [322.3, 241.7], [4422.3, 241.7]])
    assert inside.tolist() == [True, True, False]
    small = Camera(np.array([[100.0, 0, 0], [0, 100, 0], [0, 0, 1]]), 11, 6)  # whose border belongs to it
    corners = [[0, 0], [0.1, 0.05], [0.1001, 0.05], [0.1, 0.0501], [-0.0001, 0], [0, -0.0001]]
    assert small.project([[x, y, 1.0] for x, y in corners])[1].tolist() == [True, True, False, False, False, False]


def test_points_behind_get_nan():
    for name in ("pinhole", *LENSES):
        lens = Camera(K, 640, 480) if name == "pinhole" else camera(name)
        behind = rays() * [1, 1, -1]
        uv, inside = lens.project(np.vstack([behind, [[0, 0, 0], [1, 1, 0], [0, 0, 0.05], [np.nan, 0, 1]]]))
        assert not inside.any()
        assert np.isnan(uv[:-1]).all()
        assert np.isnan(uv[-1]).any()
        assert [part.shape for part in lens.project(np.zeros((0, 3)))] == [(0, 2), (0,)]


def test_a_lens_never_folds_back_into_its_picture():
    for model, D in (
        ("plumb_bob", BARREL),
        ("plumb_bob", [-0.4, 0, 0, 0, 0]),
        ("plumb_bob", [0.2, -0.3, 0, 0, 0]),
        ("rational_polynomial", [0.4, -0.1, 0, 0, -0.01, 0.7, -0.05, -0.02]),
        ("equidistant", [0.1, -0.2, 0, 0]),
    ):
        wide = Camera(np.array([[600.0, 0, 640], [0, 600, 360], [0, 0, 1]]), 1280, 720, model, np.array(D))
        radius = np.linspace(0.01, 60, 40000)
        for direction in ((1, 0), (-0.87, 0.49), (0, 1)):
            uv, inside = wide.project(np.c_[radius[:, None] * direction, np.ones_like(radius)])
            seen = np.hypot(*(uv - [640, 360]).T)
            last = np.isfinite(seen).sum()
            assert last > 50
            assert np.isfinite(seen[:last]).all()  # finite up to some angle, never again beyond
            assert (np.diff(seen[:last]) > -0.01).all()
            assert not inside[last:].any()


@pytest.mark.parametrize("name", LENSES)
def test_a_rectified_picture_has_no_empty_border(name):
    lens = camera(name)
    rectifier = Rectifier(lens)
    assert rectifier.camera.is_pinhole
    t = np.linspace(0, 1, 50)
    border = np.concatenate(
        [np.c_[639 * t, 0 * t], np.c_[639 * t, 0 * t + 479], np.c_[0 * t, 479 * t], np.c_[0 * t + 639, 479 * t]]
    )
    directions = np.c_[border, np.ones(200)] @ np.linalg.inv(rectifier.camera.K).T
    source, _ = lens.project(directions)
    assert (source > -3).all()
    assert (source < [642, 482]).all()
    # The slivers that remain repeat the picture's border instead of making an edge.
    assert (rectifier(np.full((480, 640, 3), 200, np.uint8)) == 200).all()


FISHEYE = Camera(
    np.array([[150.0, 0, 255.3], [0, 152, 190.4], [0, 0, 1]]), 512, 400, "equidistant", np.array([0.02, -0.004, 8e-4, 0])
)


SPHERE_CAMERA = Camera(np.array([[100.0, 0, 200], [0, 110, 150], [0, 0, 1]]), 401, 301, SPHERE)  # 230 deg wide


def test_the_radius_on_a_sphere_is_the_angle_from_the_axis():
    points = [[1, 0, 1], [0, -2, 0], [2, 0, -2], [3, 4, 5], [0, 0, 7], [0.05, 0, 0.05], [4, 0, -2]]
    uv, inside = SPHERE_CAMERA.project(points)
    quarter = np.pi / 4
    expected = [[quarter, 0], [0, -2 * quarter], [3 * quarter, 0], [0.6 * quarter, 0.8 * quarter], [0, 0]]
    assert np.allclose(uv[:5], [200, 150] + np.array(expected) * [100, 110])
    assert inside.tolist() == [True, False, False, True, True, False, False]
    assert np.isnan(uv[5]).all()  # too near
    assert not SPHERE_CAMERA.is_pinhole


def test_what_a_lens_does_not_show_of_its_sphere_is_told():
    for lens, least in ((FISHEYE, 0.85), (camera("plumb_bob"), 0.9), (Camera(K, 640, 480), 0.8)):
        rectifier = Rectifier(lens, lens.unrolled())
        seen = rectifier.seen()
        assert seen.shape == (rectifier.camera.height, rectifier.camera.width)
        assert least < seen.mean() <= 1
        white = rectifier(np.full((lens.height, lens.width), 200, np.uint8))
        assert (white[seen] == 200).all()
    assert Rectifier(FISHEYE).seen() is None
    absurd = Camera(K + 1e60 * np.eye(3, k=2), 640, 480, "equidistant", np.full(4, 0.01))  # beyond the range of float32
    assert not Rectifier(absurd, absurd.unrolled()).seen().any()


def test_unusable_intrinsics_are_refused():
    for change, says in (
        ({"K": np.zeros((3, 3))}, "fx=0"),
        ({"K": K.ravel()}, "3x3"),
        ({"K": np.where(K == 1, np.nan, K)}, "finite"),
        ({"K": K + np.eye(3, k=1) * [[0, 5, 0]]}, r"skew moves pixels by \d"),
        ({"width": 0}, "0x480"),
        ({"model": "ocam"}, "'ocam' is not supported.*plumb_bob"),
        ({"D": np.ones(8)}, "4 or 5 distortion coefficients, got 8"),
        ({"D": np.ones(3), "model": "equidistant"}, "equidistant has 4 or .* distortion coefficients, got 3"),
        ({"D": [0, np.inf, 0, 0]}, "finite"),
    ):
        with pytest.raises(BadInputError, match=says) as caught:
            Camera(**{"K": K, "width": 640, "height": 480, "model": "plumb_bob", **change})
        assert "\n" not in str(caught.value)


def test_a_skew_that_no_edge_shows_is_left_out():
    K_skewed = K + np.eye(3, k=1) * [[0, 1e-4, 0]]
    for D in (np.zeros(0), np.full(4, 0.01)):
        assert np.array_equal(Camera(K_skewed, 640, 480, D=D).K, K)


def test_names_that_drivers_use_zero_coefficients_and_equality():
    assert Camera(K, 640, 480, "fisheye", np.array([0.1, 0, 0, 0])).model == "equidistant"
    assert Camera(K, 640, 480, "").model == "plumb_bob"
    assert Camera(K, 640, 480, "PLUMB_BOB", np.zeros(5)).is_pinhole
    assert camera("plumb_bob") == camera("plumb_bob")
    assert Camera(K, 640, 480, "plumb_bob", np.zeros(5)) == Camera(K.copy(), 640, 480)
    assert Camera(K * (1 + 1e-12), 640, 480) == Camera(K, 640, 480)
    others = [Camera(K + np.diag([0.01, 0, 0]), 640, 480), Camera(K, 641, 480), Camera(K, 640, 481), camera("equidistant")]
    assert not any(other == Camera(K, 640, 480) for other in others)
    assert camera("plumb_bob") != camera("plumb_bob of 4")
    assert Camera(K, 640, 480) != "a camera"


def test_the_working_camera_sees_the_same_directions():
    big = Camera(np.array([[1500.0, 0, 959.5], [0, 1500, 600.1], [0, 0, 1]]), 1920, 1201)
    small = working_camera(big, 640)
    assert (small.width, small.height) == (640, 400)
    points = rays(50, 0.6)
    # Pixel centres are at integers: pixel 0 of the small picture covers the big one's 0..2.
    expected = (big.project(points)[0] + 0.5) * [640 / 1920, 400 / 1201] - 0.5
    assert np.allclose(small.project(points)[0], expected)
    assert working_camera(big, 1920) is big
    wide = FISHEYE.unrolled()
    assert working_camera(wide, 300).is_sphere
    expected = (wide.project(points)[0] + 0.5) * [300 / wide.width, round(wide.height * 300 / wide.width) / wide.height] - 0.5
    assert np.allclose(working_camera(wide, 300).project(points)[0], expected)


def test_frames_and_clouds_refuse_what_does_not_fit():
    xyz = np.zeros((4, 3), np.float32)
    for image, says in (
        (np.zeros((480, 640), np.float32), "uint8"),
        (np.zeros((480, 640, 4), np.uint8), r"480, 640, 4"),
        (np.zeros((0, 640), np.uint8), "non-empty"),
        (np.zeros((640, 480), np.uint8), "480x640, but its CameraInfo says 640x480"),
    ):
        with pytest.raises(BadInputError, match=says):
            Frame(image, PointCloud(xyz), Camera(K, 640, 480))
    with pytest.raises(BadInputError, match=r"\(n, 3\)"):
        PointCloud(xyz.T)
    for name in ("intensity", "ring", "time"):
        with pytest.raises(BadInputError, match=f"{name} has shape"):
            PointCloud(xyz, **{name: np.zeros(3, np.float32)})


def test_lost_returns_leave_a_cloud_with_all_their_fields():
    xyz = np.array([[1, 2, 3], [np.nan, 0, 0], [0, 0, 0], [4, np.inf, 0], [0, 0, 5]], np.float32)
    number = np.arange(5)
    cloud = PointCloud(xyz, number.astype(np.float32), number.astype(np.int32), number.astype(np.float32)).finite()
    assert cloud.xyz.tolist() == [[1, 2, 3], [0, 0, 5]]
    assert cloud.intensity.tolist() == cloud.ring.tolist() == cloud.time.tolist() == [0, 4]
    assert cloud.finite() is cloud

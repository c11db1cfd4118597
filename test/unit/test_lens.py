"""Lens models against OpenCV, against the closed-form inverses of their papers, and back and forth."""

from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest

from calib_ros.camera import Camera, Rectifier
from calib_ros.errors import BadInputError
from calib_ros.lens import LENSES, LensProjection

PRISM = [0.6, 0.1, 1e-4, -2e-4, 0.01, 0.9, 0.2, 0.02, 1e-3, -2e-3, 5e-4, 1e-3]
ROUND = {  # without terms off the radius -> (model, coefficients, the angle in degrees up to which images are unique)
    "omnidir": ("omnidir", [0.8], np.degrees(np.arccos(-0.8))),
    "a mirror": ("omnidir", [1.6], np.degrees(np.arccos(-1 / 1.6))),
    "double_sphere": ("double_sphere", [-0.2, 0.6], 122.051),
    "double_sphere before its pole": ("double_sphere", [0.3, 0.4], 142.366),
    "eucm": ("eucm", [0.6, 1.1], 133.170),
    "eucm before its pole": ("eucm", [0.4, 0.9], 130.316),
    "ucm": ("ucm", [0.6], np.degrees(np.arccos(-2 / 3))),
    "fov": ("fov", [0.9], 180.0),
    "division": ("division", [-0.2], 180.0),
    "division of a pincushion": ("division", [0.1], np.degrees(np.arctan(1 / (2 * np.sqrt(0.1))))),
    "division of 3": ("division", [-0.15, 0.02, -0.003], 180.0),
    "Kannala-Brandt of 6": ("equidistant", [0.02, -0.004, 8e-4, -1.5e-4, 1e-5, -1e-6], 145.70),
}
OTHER = {
    "omnidir with tangential terms": ("omnidir", [0.7, -0.05, 0.01, 1e-3, -2e-3], 80.0),
    "plumb_bob": ("plumb_bob", [-0.28, 0.07, 1e-3, -2e-3, 0.005], 55.0),
    "tilt": ("rational_polynomial", [*PRISM, 0.01, -0.02], 45.0),
}


def fan(widest: float, n: int = 500) -> np.ndarray:
    """Unit rays (n, 3) up to `widest` degrees from the axis, in all directions."""
    angle, turn = np.radians(np.linspace(0, widest, n)), np.linspace(0, 50, n)
    return np.c_[np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]


def ray_of(model: str, D: list[float], xy: np.ndarray) -> np.ndarray:
    """Unit rays (n, 3) by the closed form of the paper."""
    x, y = xy.T
    r2 = x * x + y * y
    if model == "division":
        rays = np.c_[xy, 1 + sum(k * r2 ** (i + 1) for i, k in enumerate(D))]
    elif model == "fov":
        r, w = np.sqrt(r2), D[0]
        rays = np.c_[xy * (np.sin(r * w) / (2 * np.maximum(r, 1e-12) * np.tan(w / 2)))[:, None], np.cos(r * w)]
    elif model == "omnidir":  # Mei & Rives, eq. 7
        xi = D[0]
        eta = (xi + np.sqrt(1 + (1 - xi * xi) * r2)) / (r2 + 1)
        rays = np.c_[eta * x, eta * y, eta - xi]
    elif model == "double_sphere":  # Usenko, eq. 50-52
        xi, alpha = D
        z = (1 - alpha**2 * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * r2) + 1 - alpha)
        eta = (z * xi + np.sqrt(z * z + (1 - xi * xi) * r2)) / (z * z + r2)
        rays = np.c_[eta * x, eta * y, eta * z - xi]
    else:
        alpha, beta = (*D, 1.0)[:2]
        z = (1 - beta * alpha**2 * r2) / (alpha * np.sqrt(1 - (2 * alpha - 1) * beta * r2) + 1 - alpha)
        rays = np.c_[xy, z]
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@pytest.mark.parametrize("name", [name for name, lens in ROUND.items() if lens[0] != "equidistant"])
def test_images_are_those_of_the_closed_form(name):
    model, D, limit = ROUND[name]
    rays = fan(0.98 * min(limit, 170))
    assert np.abs(ray_of(model, D, LensProjection(model, np.array(D)).image(7.0 * rays)) - rays).max() < 1e-7


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_perspective_lenses_are_those_of_opencv(count):
    """Each coefficient counts: that of thin prisms and of a tilt too."""
    D = np.array([*PRISM, 0.01, -0.02])[:count] * (0.2 if count < 8 else 1)
    K, rays = np.array([[410.0, 0, 322.3], [0, 405, 241.7], [0, 0, 1]]), fan(35)
    camera = Camera(K, 640, 480, "plumb_bob" if count < 8 else "rational_polynomial", D)
    expected = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), K, D)[0][:, 0]
    assert np.abs(camera.project(3 * rays)[0] - expected).max() < 1e-9
    for k in range(count):
        changed = Camera(K, 640, 480, camera.model, D + 0.02 * np.eye(count)[k])
        assert np.nanmax(np.abs(changed.project(3 * rays)[0] - expected)) > 0.1


def test_fisheyes_are_those_of_opencv_and_more_terms_go_on():
    D, rays = np.array([0.02, -0.01, 0.003, -0.001]), fan(80)
    expected = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), np.eye(3), D)[0][:, 0]
    assert np.abs(LensProjection("equidistant", D).image(rays) - expected).max() < 1e-12
    angle = np.radians(np.linspace(0, 80, 500))
    more = LensProjection("equidistant", np.r_[D, 2e-4]).radius(angle) - LensProjection("equidistant", D).radius(angle)
    assert np.allclose(more, 2e-4 * angle**11, atol=1e-14)


@pytest.mark.parametrize("name", ROUND)
def test_images_are_unique_up_to_the_limit_and_nothing_is_beyond(name):
    model, D, limit = ROUND[name]
    lens = LensProjection(model, np.array(D))
    assert np.degrees(lens.limit) == pytest.approx(limit, abs=0.6 if model == "division" else 0.06)
    angle = np.linspace(0, np.pi, 20_001)
    image = lens.image(np.c_[np.sin(angle), 0 * angle, np.cos(angle)])[:, 0]
    seen = angle <= lens.limit
    assert (np.diff(image[seen]) > 0).all()
    assert np.isnan(image[~seen]).all()


@pytest.mark.parametrize("name", [*ROUND, *OTHER])
def test_rays_of_images_are_found(name):
    model, D, limit = (ROUND | OTHER)[name]
    lens, rays = LensProjection(model, np.array(D)), fan(0.99 * limit)
    assert np.abs(lens.rays(lens.image(rays)) - rays).max() < 1e-9
    if name in ROUND:
        assert lens.slope == pytest.approx(np.hypot(*lens.image(fan(1e-3, 2))[1]) / np.radians(1e-3), rel=1e-5)
    assert np.isnan(LensProjection("double_sphere", np.array([-0.2, 0.6])).rays(np.array([[9.0, 0]]))).all()


WIDE = {  # focal lengths at the axis of about 150 px
    "equidistant": (150, [0.02, -0.004, 8e-4, -1.5e-4]),
    "omnidir": (330, [1.2, -0.05, 0.01, 1e-3, -1e-3]),
    "double_sphere": (120, [-0.2, 0.6]),
    "eucm": (150, [0.6, 1.1]),
    "ucm": (150, [0.6]),
    "fov": (140, [0.9]),
    "division": (150, [-0.2]),
    "plumb_bob": (150, [-0.2, 0.03, 1e-3, -2e-3, -0.001]),
    "rational_polynomial": (150, [0.6, 0.1, 1e-4, -2e-4, 0.01, 0.9, 0.2, 0.02]),
}


@pytest.mark.parametrize("model", WIDE)
def test_straight_lines_are_straight_in_the_rectified_picture(model):
    focal, D = WIDE[model]
    camera = Camera(np.array([[focal, 0, 201.3], [0, focal, 148.8], [0, 0, 1]]), 400, 300, model, np.array(D))
    assert camera.focal == pytest.approx(150, rel=0.06)

    def picture(view: Camera) -> np.ndarray:
        """Slanted bars on a wall, as a camera sees them."""
        rays = view.unproject(np.stack(np.meshgrid(np.arange(view.width), np.arange(view.height)), axis=-1))
        with np.errstate(invalid="ignore"):
            ahead = rays[:, 2] > 0.1
            wall = rays[:, :2] / np.where(ahead, rays[:, 2], 1)[:, None]
            bars = 127 + 100 * np.tanh(12 * np.sin(5 * (wall[:, 0] + 0.3 * wall[:, 1])))
        return np.where(ahead, bars, 127).reshape(view.height, view.width).astype(np.uint8)

    rectifier = Rectifier(camera)
    difference = np.abs(rectifier(picture(camera)).astype(int) - picture(rectifier.camera))
    assert difference.mean() < 3
    assert np.percentile(difference, 99) < 30
    assert np.abs(picture(camera).astype(int) - picture(rectifier.camera)).mean() > 20
    assert camera.field_deg > 100
    assert pickle.loads(pickle.dumps(camera)) == camera
    assert Rectifier(camera, camera.unrolled()).seen().mean() > 0.7


def test_names_of_other_tools():
    K = np.array([[200.0, 0, 160], [0, 200, 120], [0, 0, 1]])
    for name, model in (
        ("pinhole-equi", "equidistant"), ("pinhole-radtan8", "rational_polynomial"), ("pinhole-fov", "fov"),
        ("kb4", "equidistant"), ("Kannala Brandt", "equidistant"), ("omni-radtan", "omnidir"), ("mei", "omnidir"),
        ("ds-none", "double_sphere"), ("EUCM", "eucm"), ("atan", "fov"), ("kb6", "equidistant"),
        ("double-sphere", "double_sphere"),
    ):  # fmt: skip
        count = 6 if name == "kb6" else max(n for n in LENSES[model].counts if n < 6 or model == "rational_polynomial")
        assert Camera(K, 320, 240, name, np.full(count, 0.01)).model == model
    assert Camera(K, 320, 240, "double_sphere", np.zeros(2)).is_pinhole
    assert Camera(K, 320, 240, "ucm", np.zeros(1)) == Camera(K, 320, 240)


@pytest.mark.parametrize(
    ("model", "D", "says"),
    [
        ("double_sphere", [0.1], "double_sphere has 2 distortion coefficients, got 1"),
        ("double_sphere", [-1.2, 0.5], "xi = -1.2 is not between -1 and inf"),
        ("eucm", [0.5, -1], "beta = -1 is not between 0 and inf"),
        ("division", [0.1] * 4, "1 or 2 or 3 distortion coefficients, got 4"),
        ("equidistant", [0.1] * 9, "4 or 5 or 6 or 7 or 8"),
        ("sphere", [0.1], "no distortion coefficients"),
    ],
)
def test_coefficients_that_are_no_lens_are_refused(model, D, says):
    with pytest.raises(BadInputError, match=says):
        Camera(np.diag([200.0, 200, 1]), 320, 240, model, np.array(D))

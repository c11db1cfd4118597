"""Rigid transforms against independent formulas: the matrix exponential, the thesis's equations written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.registration.initial_guess import nominal

RNG = np.random.default_rng(0)
AXES = RNG.standard_normal((4, 3))
AXES /= np.linalg.norm(AXES, axis=1)[:, None]
ANGLES = [0.0, 1e-12, 1e-9, 1e-8, 0.99e-6, 1.01e-6, 1e-4, 0.3, 1.0, 2.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-9]
ANGLES += [0.01, 0.0299, 0.03 - 1e-12, 0.03 + 1e-12, 0.0301, 2.999, 3.0 - 1e-9, 3.0 + 1e-9, 3.001]  # where formulas change


def random_transform(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return se3.from_parts(q * np.sign(np.linalg.det(q)), rng.uniform(-5, 5, 3))


def hat(xi: np.ndarray) -> np.ndarray:
    """se(3) matrix, written out."""
    rx, ry, rz, tx, ty, tz = xi
    return np.array([[0, -rz, ry, tx], [rz, 0, -rx, ty], [-ry, rx, 0, tz], [0, 0, 0, 0]])


def rotations_about(axis: str, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array(
        {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


def test_exp_is_the_matrix_exponential_and_log_undoes_it():
    for angle in (*ANGLES, np.pi, 3.5, 7.0):
        for axis in AXES:
            xi = np.r_[axis * angle, 3.0, -4.0, 5.0]
            assert np.allclose(se3.exp(xi), expm(hat(xi)), rtol=0, atol=1e-12 * (1 + angle) ** 2)
            if angle in ANGLES:
                assert np.allclose(se3.log(se3.exp(xi)), xi, atol=2e-6 if angle > 3 else 1e-9)


def test_exp_undoes_log_at_half_turns():
    xi = np.random.default_rng(2).normal(0, 1, (5, 6))
    assert np.array_equal(se3.exp_many(xi), [se3.exp(row) for row in xi])
    for axis in [*np.eye(3), *AXES]:
        T = se3.from_parts(2 * np.outer(axis, axis) - np.eye(3), [1, 2, 3])
        xi = se3.log(T)
        assert np.linalg.norm(xi[:3]) == pytest.approx(np.pi)
        assert np.allclose(se3.exp(xi), T, atol=1e-7)


def test_euler_angles_are_those_of_eq_2_7():
    for seed in range(5):
        yaw, pitch, roll = np.random.default_rng(seed).uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1])
        R = rotations_about("z", yaw) @ rotations_about("y", pitch) @ rotations_about("x", roll)
        assert np.allclose(se3.rotation_from_euler(yaw, pitch, roll), R)
        # Entries of eq. 2.7 that tell the three angles apart.
        assert R[2, 0] == pytest.approx(-np.sin(pitch))
        assert R[0, 1] == pytest.approx(np.cos(yaw) * np.sin(pitch) * np.sin(roll) - np.sin(yaw) * np.cos(roll))


def test_quaternions_are_in_ros_order_and_have_no_negative_w():
    quarter = rotations_about("z", np.pi / 2)
    assert np.allclose(se3.quaternion_from_rotation(quarter), [0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    for k, axis in enumerate("xyz"):  # w = 0: both signs would do
        half = se3.quaternion_from_rotation(np.round(rotations_about(axis, -np.pi)))
        assert np.array_equal(half, np.eye(4)[k])
    far = [rotations_about(axis, sign * np.deg2rad(200)) for axis in "xyz" for sign in (1, -1)]
    for R in [*far, *(random_transform(seed)[:3, :3] for seed in range(6))]:
        x, y, z, w = se3.quaternion_from_rotation(R)
        assert w >= 0
        written = [  # eq. 2.15
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        assert np.allclose(written, R)
        assert np.allclose(se3.rotation_from_quaternion([-7 * x, -7 * y, -7 * z, -7 * w]), R)


def test_inverse_and_transform():
    T, xyz = random_transform(5), RNG.standard_normal((7, 3))
    moved = np.c_[xyz, np.ones(7)] @ T.T
    assert np.allclose(se3.transform(T, xyz), moved[:, :3])
    assert np.allclose(se3.transform(se3.inverse(T), moved[:, :3]), xyz)


def test_rotation_error_is_the_angle_between():
    for angle_deg in (0.0, 1e-5, 0.05, 10.0, 179.0, 180.0):
        R = random_transform(3)[:3, :3]
        for axis in AXES:
            turned = R @ se3.exp(np.r_[np.deg2rad(angle_deg) * axis, 0, 0, 0])[:3, :3]
            assert se3.rotation_error_deg(R, turned) == pytest.approx(angle_deg, abs=2e-6)
            assert se3.rotation_error_deg(turned, R) == pytest.approx(angle_deg, abs=2e-6)
    a, b = se3.from_parts(np.eye(3), [1, 1, 1]), se3.from_parts(np.eye(3), [1.3, 1, 1.4])
    assert se3.translation_error_m(a, b) == pytest.approx(0.5)


def test_a_rounded_calibration_is_accepted_and_made_exact():
    T = random_transform(6)
    given = np.round(T, 4)
    cleaned = se3.as_transform(given)
    assert np.array_equal(given, np.round(T, 4))  # what was given is not changed
    assert np.array_equal(se3.as_transform(given.tolist()), cleaned)
    assert np.abs(cleaned[:3, :3].T @ cleaned[:3, :3] - np.eye(3)).max() < 1e-12
    assert np.abs(cleaned - T).max() < 2e-4


REFUSED = {
    "text": "abc",
    "3x4": np.eye(4)[:3].tolist(),
    "nan": np.diag([1, 1, np.nan, 1]),
    "reflection": np.diag([1.0, 1, -1, 1]),
    "scaled": np.diag([1.01, 1.01, 1.01, 1]),
    "skewed": np.eye(4) + np.eye(4, k=1) * 0.01,
    "last row": np.eye(4) + 0.1 * np.outer([0, 0, 0, 1], [1, 0, 0, 0]),
    "millimetres": se3.from_parts(np.eye(3), [0, -80, -270]),
    "too large a number": [[10**400, 0, 0, 0]] * 4,
}


def test_invalid_transforms_and_quaternions_are_refused():
    for q in ([0, 0, 0, 0], [0, 0, 1], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1], 1.0):
        with pytest.raises(BadInputError, match="no rotation"):
            se3.rotation_from_quaternion(q)
    for value in REFUSED.values():
        with pytest.raises(BadInputError, match="the thing"):
            se3.as_transform(value, "the thing")
    with pytest.raises(BadInputError, match="translation of 45, as if in millimetres; give metres"):
        se3.as_transform(se3.from_parts(np.eye(3), [0, -45, 12]))


@pytest.mark.parametrize(("yaw", "seen"), [(0, [1, 0, 0]), (90, [0, 1, 0]), (180, [-1, 0, 0]), (-30, [np.sqrt(0.75), -0.5, 0])])
def test_nominal_extrinsic_looks_along_x_turned_left(yaw, seen):
    T = nominal(yaw)
    camera = se3.transform(T, [np.array(seen) * 10, [0, 0, 5]])
    assert np.allclose(camera[0], [0, 0, 10])  # straight ahead
    assert np.allclose(camera[1], [0, -5, 0])  # above is up in the picture

"""Rigid-body transforms on 4x4 matrices (thesis, chapter 2).

Conventions: ``T_target_source`` maps points from source to target; a twist is ``xi = (rx, ry, rz, tx, ty, tz)`` in radians
and metres and perturbs on the left, ``T' = exp(xi) @ T``.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from calib_ros.arrays import Matrix
from calib_ros.errors import BadInputError

N = TypeVar("N", float, Matrix)
MAX_TRANSLATION_M = 30.0  # per axis, longer than vehicles: what is further is in millimetres, or of a map
# Optical axes (x right, y down, z forward) in terms of a body's (x forward, y left, z up), as in REP 103.
OPTICAL_FROM_BODY = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def skew(v: ArrayLike) -> Matrix:
    """(3,) vector -> (3, 3) matrix with ``skew(a) @ b == cross(a, b)``."""
    x, y, z = np.asarray(v, float)
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _series(angle: float) -> tuple[float, float, float]:
    """sin(x)/x, (1 - cos(x))/x^2 and (x - sin(x))/x^3, exact where the closed forms lose their digits."""
    if angle < 0.03:
        q = angle * angle
        return 1 - q / 6 * (1 - q / 20 * (1 - q / 42)), 0.5 - q / 24 * (1 - q / 30 * (1 - q / 56)), 1 / 6 - q / 120 * (1 - q / 42)
    sine = math.sin(angle)
    return sine / angle, 2 * (math.sin(angle / 2) / angle) ** 2, (angle - sine) / angle**3


def exp(xi: ArrayLike) -> Matrix:
    """Twist (6,) in rad and m -> transform (4, 4) (Barfoot, State Estimation for Robotics, eq. 7.25 and 7.37)."""
    # Written out in numbers, as log and inverse: in the inner loop of every search a NumPy call on three numbers costs more.
    a, b, c, x, y, z = np.asarray(xi, float).tolist()
    rows = _rows(a, b, c, x, y, z, *_series(math.sqrt(a * a + b * b + c * c)))
    return np.array([*rows, [0.0, 0.0, 0.0, 1.0]])


def exp_many(xi: ArrayLike) -> Matrix:
    """Twists (n, 6) in rad and m -> transforms (n, 4, 4)."""
    a, b, c, x, y, z = np.asarray(xi, float).reshape(-1, 6).T
    series = np.array([_series(angle) for angle in np.sqrt(a * a + b * b + c * c).tolist()]).reshape(-1, 3).T
    T = np.zeros((len(a), 4, 4))
    T[:, :3] = np.moveaxis(np.array(_rows(a, b, c, x, y, z, *series)), 2, 0)
    T[:, 3, 3] = 1
    return T


def _rows(a: N, b: N, c: N, x: N, y: N, z: N, s: N, h: N, q: N) -> list[list[N]]:
    """Upper three rows of exp of the twist (a, b, c, x, y, z), or of n of them. s, h, q: `_series` of the angle."""
    # R = 1 + s S + h S S, V = 1 + h S + q S S, with S S = r r^T - |r|^2
    aa, bb, cc, ab, ac, bc = a * a, b * b, c * c, a * b, a * c, b * c
    # V t = t + h (r x t) + q (r x (r x t))
    u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
    return [
        [1 - h * (bb + cc), h * ab - s * c, h * ac + s * b, x + h * u + q * (b * w - c * v)],
        [h * ab + s * c, 1 - h * (aa + cc), h * bc - s * a, y + h * v + q * (c * u - a * w)],
        [h * ac - s * b, h * bc + s * a, 1 - h * (aa + bb), z + h * w + q * (a * v - b * u)],
    ]


def log(T: ArrayLike) -> Matrix:
    """Transform (4, 4) -> twist (6,) in rad and m, rotation angle in [0, pi]."""
    T = np.asarray(T, float)
    (r00, r01, r02, x), (r10, r11, r12, y), (r20, r21, r22, z), _ = T.tolist()
    a, b, c = 0.5 * (r21 - r12), 0.5 * (r02 - r20), 0.5 * (r10 - r01)  # the axis times the sine of the angle
    angle = math.atan2(math.sqrt(a * a + b * b + c * c), 0.5 * (r00 + r11 + r22 - 1))
    if angle > 3.0:  # near half a turn the sine does not determine the axis
        q = quaternion_from_rotation(T[:3, :3])
        a, b, c = (2 * math.atan2(float(np.linalg.norm(q[:3])), q[3]) / np.linalg.norm(q[:3]) * q[:3]).tolist()
    else:
        sine = _series(angle)[0]
        a, b, c = a / sine, b / sine, c / sine
    angle = math.sqrt(a * a + b * b + c * c)
    sine, cosine, _ = _series(angle)
    rest = 1 / 12 + angle**2 / 720 if angle < 0.03 else (1 - sine / (2 * cosine)) / angle**2
    # V^-1 t = t - (r x t) / 2 + rest (r x (r x t))
    u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
    return np.array([
        a, b, c,
        x - 0.5 * u + rest * (b * w - c * v), y - 0.5 * v + rest * (c * u - a * w), z - 0.5 * w + rest * (a * v - b * u),
    ])  # fmt: skip


def inverse(T: ArrayLike) -> Matrix:
    """Inverse of a rigid transform (4, 4), by eq. 2.18."""
    (r00, r01, r02, x), (r10, r11, r12, y), (r20, r21, r22, z), _ = np.asarray(T, float).tolist()
    return np.array([
        [r00, r10, r20, -(r00 * x + r10 * y + r20 * z)],
        [r01, r11, r21, -(r01 * x + r11 * y + r21 * z)],
        [r02, r12, r22, -(r02 * x + r12 * y + r22 * z)],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip


def adjoint(T: ArrayLike) -> Matrix:
    """(6, 6) that turns twists on the right of T (4, 4) into those on its left: T exp(xi) = exp(adjoint(T) xi) T."""
    T = np.asarray(T, float)
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = T[:3, :3]
    out[3:, :3] = skew(T[:3, 3]) @ T[:3, :3]
    return out


def parts_jacobian(T: ArrayLike) -> Matrix:
    """(6, 6) from a small left twist of T (4, 4), rad and m, to how its rotation vector and its translation change."""
    out = np.eye(6)
    out[3:, :3] = -skew(np.asarray(T, float)[:3, 3])
    return out


def transform(T: ArrayLike, points: ArrayLike) -> Matrix:
    """Apply T (4, 4) to points (n, 3), eq. 2.20."""
    T = np.asarray(T, float)
    return np.asarray(np.asarray(points, float) @ T[:3, :3].T + T[:3, 3])


def from_parts(rotation: ArrayLike, translation: ArrayLike) -> Matrix:
    """Rotation (3, 3) and translation (3,) -> (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def rotation_from_vector(vector: ArrayLike) -> Matrix:
    """Rotation vector (3,) in rad -> (3, 3)."""
    return np.asarray(exp([*np.asarray(vector, float), 0.0, 0.0, 0.0])[:3, :3])


def rotation_vector(R: ArrayLike) -> Matrix:
    """(3, 3) -> rotation vector (3,) in rad, of an angle in [0, pi]."""
    return log(from_parts(R, np.zeros(3)))[:3]


def rotation_from_euler(yaw: float, pitch: float, roll: float) -> Matrix:
    """Intrinsic z-y-x Euler angles (alpha, beta, gamma) in rad -> (3, 3), eq. 2.7."""
    (sy, sp, sr), (cy, cp, cr) = np.sin([yaw, pitch, roll]), np.cos([yaw, pitch, roll])
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip


def quaternion_from_rotation(R: ArrayLike) -> Matrix:
    """(3, 3) -> unit quaternion (x, y, z, w) with w >= 0; ROS order (eq. 2.14 writes the real part first)."""
    R = np.asarray(R, float)
    # From its largest part, which no difference of nearly equal numbers makes (Shepperd 1978).
    trace, k = float(np.trace(R)), int(np.argmax([*np.diag(R), np.trace(R)]))
    if k == 3:
        q = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + trace])
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q = np.empty(4)
        q[[k, i, j, 3]] = 1 - trace + 2 * R[k, k], R[i, k] + R[k, i], R[j, k] + R[k, j], R[j, i] - R[i, j]
    q /= np.linalg.norm(q)
    x, y, z, w = q.tolist()
    return q if (w, x, y, z) > (0, 0, 0, 0) else -q


def rotation_from_quaternion(xyzw: ArrayLike) -> Matrix:
    """Quaternion (x, y, z, w) of any non-zero norm -> (3, 3), eq. 2.15. BadInputError when the norm is zero or not finite."""
    q = np.asarray(xyzw, float)
    if q.shape != (4,) or not np.isfinite(q).all() or np.linalg.norm(q) < 1e-9:
        raise BadInputError(f"quaternion {q.tolist()} is no rotation; give x, y, z, w with a norm of 1")
    S, w = skew(q[:3]), q[3]
    return np.asarray(np.eye(3) + 2 * (w * S + S @ S) / (q @ q))


def rotation_error_deg(R_reference: ArrayLike, R: ArrayLike) -> float:
    """Angle of R_refᵀ R in degrees, eq. 2.19; (4, 4) transforms are accepted too."""
    A, B = np.asarray(R_reference, float)[:3, :3], np.asarray(R, float)[:3, :3]
    return float(np.rad2deg(np.linalg.norm(rotation_vector(A.T @ B))))


def translation_error_m(T_reference: ArrayLike, T: ArrayLike) -> float:
    """Distance of the translations of two (4, 4) transforms in metres."""
    return float(np.linalg.norm(np.asarray(T, float)[:3, 3] - np.asarray(T_reference, float)[:3, 3]))


def error(T_reference: ArrayLike, T: ArrayLike) -> tuple[float, float]:
    """Both errors, deg and m."""
    return rotation_error_deg(T_reference, T), translation_error_m(T_reference, T)


def as_transform(value: ArrayLike, what: str = "transform") -> Matrix:
    """Check that `value` is a rigid transform (4, 4) and return it as float64, with its rotation made exactly orthonormal.

    BadInputError when the shape is wrong, a value is not finite, the rotation is not orthonormal to 1e-3 (published
    calibrations are rounded) or is a reflection, or the translation is longer than MAX_TRANSLATION_M.
    """
    try:
        T = np.array(value, float)
    except (TypeError, ValueError, OverflowError):
        raise BadInputError(f"{what} is not a 4x4 matrix of numbers") from None
    if T.shape != (4, 4):
        raise BadInputError(f"{what} must be a 4x4 matrix, got shape {T.shape}")
    if not np.isfinite(T).all():
        raise BadInputError(f"{what} holds NaN or infinity; give finite numbers")
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise BadInputError(f"{what} is not a rigid transform: its 3x3 part must be a rotation and its last row 0 0 0 1")
    if np.abs(T[:3, 3]).max() > MAX_TRANSLATION_M:
        length = np.abs(T[:3, 3]).max()
        raise BadInputError(
            f"{what} has a translation of {length:.4g}, as if in millimetres; give metres, at most {MAX_TRANSLATION_M:g} per axis"
        )
    u, _, vt = np.linalg.svd(R)
    T[:3, :3] = u @ vt
    return T


def perturb(T: ArrayLike, rotation_deg: ArrayLike, translation_m: ArrayLike) -> Matrix:
    """Left perturbation by a rotation vector in degrees (3,) and a shift in metres (3,), both in the target frame."""
    D = from_parts(rotation_from_vector(np.deg2rad(np.asarray(rotation_deg, float))), translation_m)
    return np.asarray(D @ np.asarray(T, float))

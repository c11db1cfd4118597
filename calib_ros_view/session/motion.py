"""Moving an extrinsic by hand: six numbers in the camera's axes, and what they mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros.arrays import Matrix

STEP_DEG, STEP_CM, LARGE = 0.05, 1.0, 10  # of a key, and with shift so many times as far


@dataclass(frozen=True)
class Axis:
    """One of the six numbers.

    more, less: what a larger and a smaller one mean, for people. keys: that make it larger and smaller; arrows move the points in
    the picture. unit: deg or cm.
    """

    name: str
    title: str
    more: str
    less: str
    keys: tuple[str, str]
    unit: str


AXES = (
    Axis("rx", "pitch", "camera looks further down", "camera looks further up", ("ArrowUp", "ArrowDown"), "deg"),
    Axis("ry", "yaw", "camera looks further left", "camera looks further right", ("ArrowRight", "ArrowLeft"), "deg"),
    Axis("rz", "roll", "camera is rolled anticlockwise", "camera is rolled clockwise", ("e", "q"), "deg"),
    Axis("tx", "sideways", "camera further left", "camera further right", ("a", "d"), "cm"),
    Axis("ty", "height", "camera further up", "camera further down", ("r", "f"), "cm"),
    Axis("tz", "forward", "camera further back", "camera further forward", ("s", "w"), "cm"),
)


def moved(start: Matrix, values: Matrix) -> Matrix:
    """The start (4, 4) moved by (6,) deg and cm: the LiDAR is shifted along the camera's axes, then all turns about the camera.

    So a rotation leaves the camera where it is, as one turns a camera on its mount. Inverse of `offsets`.
    """
    R = Rotation.from_rotvec(np.deg2rad(values[:3])).as_matrix()
    return se3.from_parts(R @ start[:3, :3], R @ (start[:3, 3] + np.asarray(values[3:]) / 100.0))


def offsets(start: Matrix, T: Matrix) -> Matrix:
    """The numbers (6,), deg and cm, that move the start (4, 4) to T (4, 4)."""
    R = T[:3, :3] @ start[:3, :3].T
    shift = R.T @ T[:3, 3] - start[:3, 3]
    return np.concatenate([np.rad2deg(Rotation.from_matrix(R).as_rotvec()), 100.0 * shift])


def step_of(key: str, shift: bool) -> tuple[int, float] | None:
    """Number of the axis that a key moves, and by how much, deg or cm; None if it moves nothing."""
    for k, axis in enumerate(AXES):
        for sign, own in zip((1, -1), axis.keys, strict=True):
            if own in (key, key.lower()):  # shift makes letters capital
                return k, sign * (STEP_DEG if axis.unit == "deg" else STEP_CM) * (LARGE if shift else 1)
    return None

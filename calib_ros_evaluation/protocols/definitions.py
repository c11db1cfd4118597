"""The published protocols: how far off their trials begin, on how many frames, and what counts as success."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_ros import se3
from calib_ros_check.outcome import Tolerance

Matrix = NDArray[np.float64]
COUNTS = (1, 3, 5, 10)  # frames per trial, unless said otherwise
DETECTION_COUNTS = (1, 3, 5)  # the same, of MISCALIBRATION
TRIALS = 100  # per cell, unless said otherwise


class Size(NamedTuple):
    """Of a start error, per axis of the camera: a rotation vector in +-deg and a shift in +-m."""

    deg: float
    m: float

    @property
    def words(self) -> str:
        """For people."""
        return f"{self.deg:g} deg" if not self.m else f"{self.deg:g} deg, {100 * self.m:g} cm"


@dataclass(frozen=True)
class Protocol:
    """A published protocol of calibrations from wrong starts.

    sizes: of the start errors. limit_deg, limit_m: below both, the end counts as success. amplitude: whether each start first
    draws how large it may be at most, uniformly in 0..size and once for the rotation and once for the shift, and then each axis
    within that; else each axis is uniform within the size itself.
    """

    name: str
    sizes: tuple[Size, ...]
    limit_deg: float
    limit_m: float
    amplitude: bool = False

    def start(self, T: Matrix, size: Size, rng: np.random.Generator) -> Matrix:
        """T_camera_lidar (4, 4) of a trial: a left perturbation, in the camera's frame, of T (4, 4)."""
        share = rng.uniform(0, 1, 2)
        axes = rng.uniform(-1, 1, (2, 3)) * (share[:, None] if self.amplitude else 1.0)
        return se3.perturb(T, size.deg * axes[0], size.m * axes[1])


SINGLE_FRAME = Protocol("projfusion", (Size(10, 0.25), Size(10, 0.5), Size(15, 0.15)), 2.0, 0.05, amplitude=True)
BORER = Protocol("borer", (Size(10, 0), Size(0.5, 0.5)), 0.5, 0.2)
# UniCalib states mean errors and no limits of success; those of SINGLE_FRAME tell how many of our trials are meant.
UNICALIB = Protocol("unicalib", (Size(5, 0.1), Size(10, 0.25)), 2.0, 0.05)
MISCALIBRATION = "miscalibration"  # which checks extrinsics and calibrates nothing, see detection.py
SHIFT, ROTATION = ("x_m", "y_m", "z_m"), ("rx_deg", "ry_deg", "rz_deg")  # columns of its published perturbations
DOUBLED = 2.0  # the published code turns by twice the degrees of its table, and so do the published figures
TOLERANCE = Tolerance(1.0, 0.05)  # what the set of right ones lies within: up to 1.0 deg and 3.5 cm
PROTOCOLS = {one.name: one for one in (SINGLE_FRAME, BORER, UNICALIB)}
NAMES = (SINGLE_FRAME.name, MISCALIBRATION, BORER.name, UNICALIB.name)


def displacement(values: Mapping[str, Any]) -> Matrix:
    """(4, 4) that the right extrinsic is multiplied with from the right, T_camera_lidar D: a rotation vector of DOUBLED the
    printed degrees, and the shift."""
    shift, turn = ([float(values[name]) for name in names] for names in (SHIFT, ROTATION))
    return se3.from_parts(Rotation.from_rotvec(DOUBLED * np.deg2rad(turn)).as_matrix(), shift)

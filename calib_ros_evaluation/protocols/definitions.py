"""The published protocols: how far off their trials begin, on how many frames, and what counts as success."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.errors import BadInputError

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
PROTOCOLS = {one.name: one for one in (SINGLE_FRAME, BORER, UNICALIB)}
NAMES = (SINGLE_FRAME.name, MISCALIBRATION, BORER.name, UNICALIB.name)


def check_name(name: str) -> None:
    """BadInputError for a protocol that there is not."""
    if name not in NAMES:
        raise BadInputError(f"there is no protocol '{name}'; choose among {', '.join(NAMES)}")

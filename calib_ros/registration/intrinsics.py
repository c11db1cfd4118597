"""Do the intrinsics fit the scenes?

With a wrong focal length or principal point another extrinsic matches best, by decimetres and degrees elsewhere, and everything
else about it looks right. But the match itself is worse than with the right ones: so the extrinsic is refined again for cameras
with other intrinsics nearby.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.constraints import Limits
from calib_ros.registration.covariance import NO_NOISE, noise_covariance, noise_level
from calib_ros.registration.optimizers import levenberg_marquardt
from calib_ros.registration.refusal import WrongIntrinsics
from calib_ros.registration.score import PointScore

Matrix = NDArray[np.float64]
POINTS = 6000  # edge points, so that many frames do not cost more
# On which an extrinsic is refined with other intrinsics: 3 % of the focal length move it by 3 deg and 40 cm.
LEVELS = (1, 2, 3, 4)
REACH = np.array([np.deg2rad(6.0)] * 3 + [0.8] * 3)  # rad, m; twice as far as that
FOCAL = (-0.06, -0.04, -0.03, -0.02, -0.01, 0.01, 0.02, 0.03, 0.04, 0.06)  # shares of the focal length
CENTRE = (-0.03, -0.02, -0.01, 0.01, 0.02, 0.03)  # shares of the image width, each way


# Gain from which other intrinsics are preferred, in standard deviations of the score and as a share of it, and the frames it
# takes: one frame may gain 7 by chance. Of 59 sets of five frames of 20 rigs and seven vehicles that are accepted with the right
# ones, focal lengths gain at most 1.0 and principal points 2.2, or 3.5 but 1 % of the score (a rolling shutter). Focal lengths
# 3 % wrong gain 3.5 to 9, and 12 to 150 % of the score. Principal points 2 % of the image width beside (13 to 26 px) gain 3.5 to
# 4 on average; those that gain little are rotations.
CLEARLY, LEAST_SHARE, MIN_FRAMES = 2.5, 0.05, 3


@dataclass(frozen=True)
class Intrinsics:
    """A change of a camera: focal, of its focal length as a share; u, v of its principal point, as shares of the image width."""

    focal: float = 0.0
    u: float = 0.0
    v: float = 0.0


@dataclass(frozen=True)
class IntrinsicsTest:
    """best: of all changes that were tried, the one with the best match. gain: by how much its score exceeds that of the given
    intrinsics, in standard deviations. share: the same, as a share of the score."""

    best: Intrinsics
    gain: float
    share: float

    @property
    def significant(self) -> bool:
        """True if the change is clearly better."""
        return self.gain > CLEARLY and self.share > LEAST_SHARE


def changes() -> Iterator[Intrinsics]:
    """Cameras nearby, each with one thing changed."""
    yield from (Intrinsics(focal=x) for x in FOCAL)
    yield from (Intrinsics(u=x) for x in CENTRE)
    yield from (Intrinsics(v=x) for x in CENTRE)


def intrinsics_test(score: PointScore, T: Matrix, limits: Limits) -> IntrinsicsTest:
    """Compare the match at the optimum T (4, 4) with the match of cameras nearby, each at its own optimum.

    limits: axes that are fixed stay so.
    """
    # Around T, not within a search's bounds: near one of them only other intrinsics could go on.
    limits = Limits(T, np.where(limits.open_axes, REACH, 0.0))
    part = score.subset(POINTS, np.random.default_rng(0))
    level, axes = part.n_levels - 1, np.flatnonzero(limits.open_axes)
    noise = noise_level(part, T, level, noise_covariance(part, T, level, axes, noise=1.0), axes)
    here = max(_best(part, T, limits), part.at(level).value(T))  # coarse levels may have their optimum elsewhere
    best, highest = Intrinsics(), here
    for change in changes():
        value = _best(part.with_intrinsics(change.focal, change.u, change.v), T, limits)
        if value > highest:
            best, highest = change, value
    gain = highest - here
    return IntrinsicsTest(best, float(np.sqrt(2 * gain / max(noise, NO_NOISE))), gain / max(abs(here), NO_NOISE))


def check_intrinsics(score: PointScore, T: Matrix, limits: Limits, width: int) -> WrongIntrinsics | None:
    """Why the intrinsics do not fit, None if they do or too few frames tell; see `intrinsics_test`. width: of the recorded image,
    px.

    Unrolled pictures of wide lenses are not judged: a shift is a rotation there, and lenses of another focal length are unrolled
    otherwise.
    """
    if len(np.unique(score.frame)) < MIN_FRAMES or score.camera.is_cylinder or not limits.open_axes.any():
        return None
    test = intrinsics_test(score, T, limits)
    if not test.significant:
        return None
    return WrongIntrinsics(test.best.focal, test.best.u * width, test.best.v * width, test.gain)


def _best(score: PointScore, T: Matrix, limits: Limits) -> float:
    """Score at the optimum near T (4, 4)."""
    for level in LEVELS:
        T, value = levenberg_marquardt(score.at(level), T, limits=limits, tolerance_deg=0.01, near=True)
    return value

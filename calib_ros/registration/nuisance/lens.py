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

from calib_ros.registration.acceptance.refusal import WrongIntrinsics
from calib_ros.registration.nuisance.parameters import MIN_FRAMES, Alternative, best_alternative
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits

Matrix = NDArray[np.float64]
FOCAL = (-0.06, -0.04, -0.03, -0.02, -0.01, 0.01, 0.02, 0.03, 0.04, 0.06)  # shares of the focal length
CENTRE = (-0.03, -0.02, -0.01, 0.01, 0.02, 0.03)  # shares of the image width, each way


@dataclass(frozen=True)
class Intrinsics:
    """A change of a camera: focal, of its focal length as a share; u, v of its principal point, as shares of the image width."""

    focal: float = 0.0
    u: float = 0.0
    v: float = 0.0


def changes() -> Iterator[Intrinsics]:
    """Cameras nearby, each with one thing changed."""
    yield from (Intrinsics(focal=x) for x in FOCAL)
    yield from (Intrinsics(u=x) for x in CENTRE)
    yield from (Intrinsics(v=x) for x in CENTRE)


def better_intrinsics(score: PointScore, T: Matrix, limits: Limits) -> Alternative[Intrinsics] | None:
    """The camera nearby with the best match, around the optimum T (4, 4); None if none is better than the given one.

    limits: axes that are fixed stay so.
    """
    return best_alternative(score, T, limits, changes(), lambda part, x: (part.with_intrinsics(x.focal, x.u, x.v), T))


def check_intrinsics(score: PointScore, T: Matrix, limits: Limits, width: int) -> WrongIntrinsics | None:
    """Why the intrinsics do not fit, None if they do or too few frames tell. width: of the recorded image, px.

    Unrolled pictures of wide lenses are not judged: a shift is a rotation there, and lenses of another focal length are unrolled
    otherwise.
    """
    if len(np.unique(score.frame)) < MIN_FRAMES or score.camera.is_cylinder or not limits.open_axes.any():
        return None
    best = better_intrinsics(score, T, limits)
    if best is None or not best.significant:
        return None
    return WrongIntrinsics(best.value.focal, best.value.u * width, best.value.v * width, best.gain)

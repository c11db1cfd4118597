"""Do the intrinsics fit the scenes?

With a wrong focal length or principal point another extrinsic matches best, by decimetres and degrees elsewhere, and everything
else about it looks right. But the match itself is worse than with the right ones: so focal length and principal point are
estimated, with the extrinsic refined again for each of their values.

Unrolled pictures of wide lenses show neither: a shift is a rotation there, and lenses of another focal length are unrolled
otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.config import CameraConfig
from calib_ros.registration.acceptance.refusal import WrongIntrinsics
from calib_ros.registration.nuisance.parameters import Changed, NuisanceParameter
from calib_ros.registration.score.point_score import PointScore

FOCAL = (-0.06, -0.04, -0.02, -0.01, 0.01, 0.02, 0.04, 0.06)  # shares of the focal length
CENTRE = (-0.03, -0.015, 0.015, 0.03)  # shares of the image width, each way


@dataclass(frozen=True, eq=False)
class FocalLength(NuisanceParameter):
    """The focal length, as a share of it."""

    name = "focal_length_share"
    gross = 0.03
    step = 0.005  # 3 px at the border of an image of 1280
    alternatives = FOCAL

    def changed(self, score: PointScore, T: Transform, value: float) -> Changed:
        """See NuisanceParameter."""
        return score.with_intrinsics(value, 0.0, 0.0), T

    def observable_in(self, score: PointScore) -> bool:
        """See NuisanceParameter."""
        return not score.camera.is_cylinder

    def refusal(self, value: float, deviations: float) -> WrongIntrinsics:
        """See NuisanceParameter."""
        return WrongIntrinsics(value, 0.0, 0.0, deviations)


@dataclass(frozen=True, eq=False)
class PrincipalPoint(NuisanceParameter):
    """A coordinate of the principal point, as a share of the image width. axis: 0 across, 1 down. width: of the recorded image,
    px."""

    axis: int
    width: int
    gross = 0.03
    step = 0.005
    alternatives = CENTRE

    @property
    def name(self) -> str:
        """See NuisanceParameter."""
        return f"principal_point_{'xy'[self.axis]}_px"

    @property
    def unit(self) -> float:
        """See NuisanceParameter."""
        return float(self.width)

    def _shift(self, value: float) -> tuple[float, float]:
        return (value, 0.0) if self.axis == 0 else (0.0, value)

    def changed(self, score: PointScore, T: Transform, value: float) -> Changed:
        """See NuisanceParameter."""
        across, down = self._shift(value * score.camera.width / score.camera.K[0, 0])  # what it looks like: a rotation
        return score.with_intrinsics(0.0, *self._shift(value)), se3.exp([down, -across, 0.0, 0.0, 0.0, 0.0]) @ T

    def observable_in(self, score: PointScore) -> bool:
        """See NuisanceParameter."""
        return not score.camera.is_cylinder

    def refusal(self, value: float, deviations: float) -> WrongIntrinsics:
        """See NuisanceParameter."""
        u, v = self._shift(value * self.width)
        return WrongIntrinsics(0.0, u, v, deviations)


def intrinsics(config: CameraConfig, width: int) -> tuple[NuisanceParameter, ...]:
    """The intrinsics of a camera with images of this width, px, each a parameter of its own: those that are not exact."""
    focal, centre = FocalLength(config.focal_sigma), [PrincipalPoint(config.centre_sigma, axis, width) for axis in (0, 1)]
    return tuple(parameter for parameter in (focal, *centre) if parameter.sigma > 0)

"""Do the intrinsics fit the scenes?

With a wrong focal length or principal point another extrinsic matches best, by decimetres and degrees elsewhere, but worse than
with the right ones: so they are estimated, with the extrinsic refined again for each of their values. Unrolled pictures of wide
lenses show neither: a shift is a rotation there, and lenses of another focal length are unrolled otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.config import CameraConfig
from calib_ros.intrinsics import CENTRE as CENTRE_NAMES
from calib_ros.intrinsics import FOCAL as FOCAL_NAME
from calib_ros.registration.acceptance.refusal import Refusal, wrong_intrinsics
from calib_ros.registration.nuisance.parameters import Changed, NuisanceParameter
from calib_ros.registration.score.point_score import PointScore

FOCAL = (-0.06, -0.04, -0.02, -0.01, 0.01, 0.02, 0.04, 0.06)  # shares of the focal length
CENTRE = (-0.03, -0.015, 0.015, 0.03)  # shares of the image width, each way


@dataclass(frozen=True, eq=False)
class Intrinsic(NuisanceParameter):
    """The focal length, as a share of it, or a coordinate of the principal point, as a share of the image width.

    name: of calib_ros.intrinsics. width: of the recorded image, px.
    """

    name: str = FOCAL_NAME
    width: int = 1
    gross = 0.03
    step = 0.005  # 3 px at the border of an image of 1280

    @property
    def unit(self) -> float:
        return 1.0 if self.name == FOCAL_NAME else float(self.width)

    @property
    def alternatives(self) -> Sequence[float]:
        return FOCAL if self.name == FOCAL_NAME else CENTRE

    def changed(self, score: PointScore, T: Transform, value: float) -> Changed:
        _, across, down = self._of_all(value * score.camera.width / score.camera.K[0, 0])  # what it looks like: a rotation
        return score.with_intrinsics(*self._of_all(value)), se3.exp([down, -across, 0.0, 0.0, 0.0, 0.0]) @ T

    def observable_in(self, score: PointScore) -> bool:
        return not score.camera.is_sphere

    def refusal(self, value: float, deviations: float) -> Refusal:
        return wrong_intrinsics(*self._of_all(value * self.unit), deviations)

    def _of_all(self, value: float) -> tuple[float, float, float]:
        """The value among focal length and both coordinates, the others 0."""
        focal, u, v = (value if name == self.name else 0.0 for name in (FOCAL_NAME, *CENTRE_NAMES))
        return focal, u, v


def intrinsics(config: CameraConfig, width: int) -> tuple[NuisanceParameter, ...]:
    """The intrinsics of a camera with images of this width, px, each a parameter of its own: those that are not exact."""
    centre = [Intrinsic(config.centre_sigma, name, width) for name in CENTRE_NAMES]
    return tuple(parameter for parameter in (Intrinsic(config.focal_sigma), *centre) if parameter.sigma > 0)

"""A picture, and points that know how much light they reflect: what methods keep that compare the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import ScoreConfig
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.evaluation.methods.view import View
from calib_ros.registration.projection import near_image

Matrix = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LitPoints:
    """light: (h, w) grey values or their bins. camera: its pinhole. xyz: (n, 3) float32 m, LiDAR frame. level: (n,) bin of each
    point's reflectivity."""

    light: NDArray[np.uint8]
    camera: Camera
    xyz: NDArray[np.float32]
    level: NDArray[np.intp]

    def select(self, keep: NDArray[np.intp]) -> LitPoints:
        """Some of the points, by index."""
        return replace(self, xyz=self.xyz[keep], level=self.level[keep])


def known_reflectivity(view: View, frame_name: str) -> NDArray[np.float32]:
    """Reflectivity (n,) of a view's points, 0..1. BadInputError if it has none."""
    if view.reflectivity is None:
        raise BadInputError(
            f"frame {frame_name}: the cloud has no reflectivity, or the same everywhere, and this method compares nothing else; "
            "record the field intensity, or leave this method out"
        )
    return view.reflectivity


def all_near_image(features: Sequence[LitPoints], T: Matrix, config: ScoreConfig) -> list[LitPoints]:
    """The points of every frame that project near the image at T (4, 4): within ``score.margin`` of its width."""
    return enough([f.select(near_image(f.xyz, T, f.camera, config.margin)) for f in features], config)


def enough(features: list[LitPoints], config: ScoreConfig) -> list[LitPoints]:
    """The same; TooFewFeaturesError if they have fewer than ``score.min_points`` points in all."""
    found = sum(len(f.xyz) for f in features)
    if found < config.min_points:
        raise TooFewFeaturesError(
            f"only {found} points near the image in {len(features)} frames (need {config.min_points}); "
            "check the initial extrinsic and that the LiDAR sees what the camera sees"
        )
    return features

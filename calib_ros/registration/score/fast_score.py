"""The score of the method: which edge points count, by how much, and on which maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.arrays import Transform
from calib_ros.config import ScoreConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.lidar.edges import UPWARD, EdgeKind, EdgePoints
from calib_ros.registration.features import FrameFeatures
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.point_score import MARGIN, MIN_POINTS, PointScore, near_image

# Weights of the kinds of edges, beside that of reflectivity, which users set: what is often no edge in the image weighs less.
WEIGHT_SIDE, WEIGHT_TOP, WEIGHT_SKY_SIDE, WEIGHT_SKY_TOP = 1.0, 0.6, 0.5, 0.3
RING_SPACING_DEG = 0.4  # deg; upward edges of sparser rings weigh less by the square root of the ratio: they are less exact
WEIGHT_FLOOR = 150  # edge points of a frame and kind below which its weight fades, so that a few do not dominate
# By the number of a kind: a set of them takes np.isin longer than all else that is done with few points.
_IS_UPWARD = np.isin(np.arange(max(EdgeKind) + 1), UPWARD)


class FastScore(PointScore):
    """The score of the method: sparse edge points of several frames on oriented edge maps.

    features: of one camera. T_prior: (4, 4); edge points that it projects farther than `margin` (share of the image width; None =
    MARGIN) outside the image are left out. atlas: of the same features, if there is one already.
    Raises TooFewFeaturesError when fewer than MIN_POINTS edge points remain.
    """

    def __init__(
        self,
        features: list[FrameFeatures],
        T_prior: Transform,
        config: ScoreConfig,
        margin: float | None = None,
        atlas: Atlas | None = None,
    ) -> None:
        if not features:
            raise TooFewFeaturesError("no frame can be used; give others")
        camera, margin = features[0].camera, MARGIN if margin is None else margin
        kept = [f.points.select(near_image(f.points.xyz, T_prior, camera, margin)) for f in features]
        frame = np.concatenate([np.full(len(p), j, np.int32) for j, p in enumerate(kept)])
        if len(frame) < MIN_POINTS:
            raise TooFewFeaturesError(
                f"{len(frame) or 'no'} edge points near the image in {len(features)} frames, {MIN_POINTS} are needed; "
                "wait for a scene with objects, or check the initial extrinsic"
            )
        weights = np.concatenate([_weights(p, config) for p in kept])
        # A camera mounted on its side sees side and upward edges exchanged.
        axes = [np.abs(T_prior[:3, :3] @ p.pose.axis) for p in kept]
        channels = [(_IS_UPWARD[p.kind] != (axis[0] > axis[1])).astype(np.intp) for p, axis in zip(kept, axes, strict=True)]
        super().__init__(
            np.concatenate([p.xyz for p in kept]).T,
            (weights / weights.sum()).astype(np.float32),
            frame,
            np.concatenate(channels),
            atlas or Atlas([f.levels for f in features], camera),
        )


def _weights(points: EdgePoints, config: ScoreConfig) -> NDArray[np.float64]:
    """Weights (n,) of one frame's points: every kind shares its weight out; upward edges of few rings, less exact, count less."""
    upward = float(np.sqrt(min(1.0, np.deg2rad(RING_SPACING_DEG) / max(points.ring_spacing, 1e-6))))
    of_kind = {
        EdgeKind.SIDE: WEIGHT_SIDE,
        EdgeKind.TOP: WEIGHT_TOP * upward,
        EdgeKind.REFLECTIVITY: config.weight_reflectivity,
        EdgeKind.SKY_SIDE: WEIGHT_SKY_SIDE,
        EdgeKind.SKY_TOP: WEIGHT_SKY_TOP * upward,
    }
    strength, share = points.strength.astype(np.float64), np.zeros(max(EdgeKind) + 1)
    for kind, weight in of_kind.items():
        own = strength[points.kind == kind]
        if len(own):
            share[kind] = weight / max(own.sum(), WEIGHT_FLOOR * own.mean())
    return strength * share[points.kind]

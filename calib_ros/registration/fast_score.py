"""The fast edge registration score: sparse edge points of all frames on oriented, multi-level edge maps.

It is the weighted mean of the standardised edge strength under the edge points: 0 by chance, about 1 when well aligned.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import ScoreConfig
from calib_ros.errors import TooFewFeaturesError
from calib_ros.lidar.edge_points import UPWARD, EdgeKind, EdgePoints
from calib_ros.registration.atlas import Atlas
from calib_ros.registration.class_edges import channels, frame_weights
from calib_ros.registration.frame_features import FrameFeatures
from calib_ros.registration.point_score import PointScore, ScoredPoints
from calib_ros.registration.projection import near_image

Matrix = NDArray[np.float64]


class FastScore(PointScore):
    """Score of an extrinsic over several frames at several resolutions.

    features: of one camera. T_prior: (4, 4); edge points that it projects far outside the image are left out. margin: how
    far, as a share of the image width; None = ``score.margin``. atlas: of the same features, if there is one already. Raises
    TooFewFeaturesError when fewer than ``score.min_points`` edge points remain.
    """

    def __init__(
        self,
        features: list[FrameFeatures],
        T_prior: Matrix,
        config: ScoreConfig,
        margin: float | None = None,
        atlas: Atlas | None = None,
    ) -> None:
        if not features:
            raise TooFewFeaturesError("no frame to score; give at least one")
        camera, margin = features[0].camera, config.margin if margin is None else margin
        kept = [f.points.select(near_image(f.points.xyz, T_prior, camera, margin)) for f in features]
        frame = np.concatenate([np.full(len(p), j, np.int32) for j, p in enumerate(kept)])
        if len(frame) < config.min_points:
            raise TooFewFeaturesError(
                f"only {len(frame)} edge points near the image in {len(features)} frames (need {config.min_points}); "
                "wait for a scene with objects, or check the initial extrinsic"
            )
        of_frames = frame_weights([f.importance for f in features])
        weights = np.concatenate([w * _weights(p, config) for w, p in zip(of_frames, kept, strict=True)])
        points = ScoredPoints(
            np.ascontiguousarray(np.concatenate([p.xyz for p in kept]).T),
            (weights / weights.sum()).astype(np.float32),
            frame,
            np.concatenate([_channels(f, p) for f, p in zip(features, kept, strict=True)]),
        )
        super().__init__(points, atlas or Atlas([f.levels for f in features], camera))


def _channels(features: FrameFeatures, points: EdgePoints) -> NDArray[np.intp]:
    """Which map each of a frame's points (n,) is to meet: by the direction of its edge, and by its class if that is matched."""
    upward = np.isin(points.kind, UPWARD).astype(np.intp)
    matched = points.label is not None and len(features.levels[0].maps) > 2
    return upward + 2 * channels(points.label) if matched and points.label is not None else upward


def _weights(points: EdgePoints, config: ScoreConfig) -> NDArray[np.float64]:
    """Weights (n,) of one frame's points: every kind shares its weight out, unless it has hardly any points.

    Upward edges are known to half a ring spacing only, so that they count less for scanners of few rings.
    """
    upward = float(np.sqrt(min(1.0, np.deg2rad(config.ring_spacing_deg) / max(points.ring_spacing, 1e-6))))
    of_kind = {
        EdgeKind.SIDE: config.weight_side,
        EdgeKind.TOP: config.weight_top * upward,
        EdgeKind.REFLECTIVITY: config.weight_reflectivity,
        EdgeKind.SKY_SIDE: config.weight_sky_side,
        EdgeKind.SKY_TOP: config.weight_sky_top * upward,
    }
    out = points.strength.astype(np.float64)
    for kind, weight in of_kind.items():
        own = points.kind == kind
        if own.any():
            out[own] *= weight / max(out[own].sum(), config.weight_floor * out[own].mean())
    return out

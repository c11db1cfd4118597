"""The fast score's features of a frame, with what semantics know of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config
from calib_ros.image.edges import edge_levels
from calib_ros.registration.class_edges import edge_weights, gated, importance
from calib_ros.registration.frame_features import FrameFeatures
from calib_ros.semantics.seen import OF_CLASSES, OF_MASKS

Map = NDArray[np.float32]


def with_semantics(
    plain: FrameFeatures,
    image: NDArray[np.uint8],
    edges: Map | None,
    classes: NDArray[np.uint8] | None,
    config: Config,
    edges_of: str = OF_MASKS,
) -> FrameFeatures:
    """Features with semantic edges, weights and groups of classes, as far as they are known.

    image: (h, w[, 3]) of plain.camera. edges: (2, h, w) in 0..1, classes: (h, w) SemanticClass, both of that image.
    edges_of: see Seen.
    """
    own, points = config.semantics, plain.points
    if points.label is not None:
        points = replace(points, strength=points.strength * edge_weights(points.label, own))
        # Points that weigh nothing would still be projected every time.
        points = points.select(np.flatnonzero(points.strength > 0))
    levels = plain.levels
    share = own.class_edge_share if edges_of == OF_CLASSES else own.edge_share
    if edges is not None and share > 0:
        levels = edge_levels(image, float(plain.camera.K[0, 0]), config.image, config.score, edges, share)
    if classes is not None and points.label is not None and own.match_classes:
        levels = gated(levels, classes)
    weight = importance(classes) if classes is not None and own.frame_weights else None
    return replace(plain, points=points, levels=levels, importance=weight, plain=plain)

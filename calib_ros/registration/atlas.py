"""The maps of all frames as tiles of one large image per resolution, so that a single cv2.remap samples them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.errors import TooFewFeaturesError
from calib_ros.image.edges import EdgeLevel

Map = NDArray[np.float32]
PAD = 2  # empty rows and columns between tiles, so that samples outside a frame read 0
REMAP_LIMIT = 32000  # px; cv2.remap takes images of less than 2^15 pixels a side


@dataclass(frozen=True, eq=False)
class AtlasLevel:
    """All tiles at one resolution.

    image: the tiles. corner: (tiles, 2) float32, left and top edge of each. K: intrinsics at the level's scale. width,
    height: of a tile. sigma: blur in pixels of the level.
    """

    image: Map
    corner: Map
    K: NDArray[np.float64]
    width: int
    height: int
    sigma: float


class Atlas:
    """Maps of several frames of one camera. levels: per frame, its maps coarse to fine. camera: pinhole at full size."""

    def __init__(self, levels: Sequence[Sequence[EdgeLevel]], camera: Camera) -> None:
        self.camera, self.n_frames = camera, len(levels)
        self.channels = len(levels[0][0].maps)
        self.levels = [_tiled([own[k] for own in levels], camera) for k in range(len(levels[0]))]


def _tiled(levels: Sequence[EdgeLevel], camera: Camera) -> AtlasLevel:
    """Lay the maps (c, h, w) of all frames out in columns of tiles that cv2.remap can address."""
    c, h, w = levels[0].maps.shape
    per_column = max(REMAP_LIMIT // (h + PAD), 1)
    tiles = c * len(levels)
    columns = -(-tiles // per_column)
    if columns * (w + PAD) > REMAP_LIMIT:
        raise TooFewFeaturesError(
            f"{len(levels)} frames of {w}x{h} do not fit one score; use fewer frames or a smaller image.max_width"
        )
    image = np.zeros((min(tiles, per_column) * (h + PAD) + PAD, columns * (w + PAD) + PAD), np.float32)
    corner = np.array([(PAD + t // per_column * (w + PAD), PAD + t % per_column * (h + PAD)) for t in range(tiles)], np.float32)
    for t in range(tiles):
        u0, v0 = corner[t].astype(int)
        image[v0 : v0 + h, u0 : u0 + w] = levels[t // c].maps[t % c]
    scale, sigma = levels[0].scale, levels[0].sigma
    S = np.array([[1 / scale, 0, (1 / scale - 1) / 2], [0, 1 / scale, (1 / scale - 1) / 2], [0, 0, 1]])
    return AtlasLevel(image, corner, S @ camera.K, w, h, sigma / scale)

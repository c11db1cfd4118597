"""The maps of all frames as tiles of one large image per resolution, so that one pass samples them all."""

from __future__ import annotations

import copy
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.errors import TooFewFeaturesError
from calib_ros.image.edges import EdgeLevel

Map = NDArray[np.float32]
PAD = 2  # empty rows and columns between tiles, so that samples outside a frame read 0
MAX_SIDE = 32000  # px of an image of tiles: below 2^15, a float32 position is exact to 1/512 px


@dataclass(frozen=True, eq=False)
class AtlasLevel:
    """All tiles at one resolution. image: in units of UNIT. corner: (tiles, 2) float32, left and top edge of each. K:
    intrinsics at the level's scale. width, height: of a tile. sigma: blur in pixels of the level."""

    image: NDArray[np.int16]
    corner: Map
    K: NDArray[np.float64]
    width: int
    height: int
    sigma: float


class Atlas:
    """Maps of several frames of one camera.

    levels: per frame, its maps coarse to fine. camera: pinhole at full size. last: an atlas that is no longer in use, whose
    memory is taken over if it is of the same form, with the frames that stand where they should.
    """

    def __init__(self, levels: Sequence[Sequence[EdgeLevel]], camera: Camera, last: Atlas | None = None) -> None:
        self.camera, self.n_frames = camera, len(levels)
        self._correlations: dict[int, NDArray[np.float64]] = {}
        self.channels = max(len(own[0].packed) for own in levels)
        # Which frames these are is told without keeping them alive.
        self._frames = [weakref.ref(own[0]) for own in levels]
        self._form = [(level.packed.shape[1:], level.scale, level.sigma) for level in levels[0]]
        form, K = (self._form, self.n_frames, self.channels), camera.K
        fits = last is not None and form == (last._form, last.n_frames, last.channels) and np.array_equal(last.camera.K, K)
        kept = last if fits else None
        self.levels: list[AtlasLevel] = (
            kept.levels if kept else [_laid_out(levels[0][k], len(levels), self.channels, camera) for k in range(len(levels[0]))]
        )
        for j, own in enumerate(levels):
            if kept is None or kept._frames[j]() is not own[0]:
                for k, level in enumerate(self.levels):  # no point of a frame with fewer maps looks at the others' room
                    corners = level.corner[self.channels * j :].astype(int)
                    for tile, (u, v) in zip(own[k].packed, corners, strict=False):
                        level.image[v : v + level.height, u : u + level.width] = tile

    def correlation(self, level: int) -> NDArray[np.float64]:
        """How alike the edge maps of all frames are at a level, (n_frames, n_frames), 0..1. Computed once."""
        if level not in self._correlations:
            own = self.levels[level]
            corners = own.corner.reshape(self.n_frames, self.channels, 2)[:, :2].astype(int)
            parts = [[own.image[v : v + own.height : 2, u : u + own.width : 2].ravel() for u, v in both] for both in corners]
            maps = np.stack([np.concatenate(of_frame) for of_frame in parts]).astype(np.float32)
            maps -= maps.mean(axis=1, keepdims=True)
            maps /= np.maximum(np.linalg.norm(maps, axis=1, keepdims=True), 1e-6)
            found = np.clip(maps @ maps.T, 0, 1).astype(np.float64)
            np.fill_diagonal(found, 1.0)
            self._correlations[level] = found
        return self._correlations[level]

    def mirrored(self) -> Atlas:
        """The same maps as a camera sees them that is mirrored left to right: its focal length fx is negative."""
        return self._with([replace(level, K=level.K * [[-1.0, 1, 1], [1, 1, 1], [1, 1, 1]]) for level in self.levels])

    def with_intrinsics(self, focal: float, u: float, v: float) -> Atlas:
        """The same maps of a camera with a focal length longer by a share, its principal point off by shares of the width."""
        change, shift = np.array([[1 + focal, 1, 1], [1, 1 + focal, 1], [1, 1, 1]]), np.array([[0, 0, u], [0, 0, v], [0, 0, 0]])
        return self._with([replace(level, K=level.K * change + level.width * shift) for level in self.levels])

    def with_distortion(self, barrel: float) -> Atlas:
        """The same maps as an ideal lens would see them, if those of the pictures had a radial distortion that moves the corner
        towards the principal point by the share `barrel` of its radius, and other pixels less, by its square."""

        def undistorted(level: AtlasLevel) -> AtlasLevel:
            centre = level.K[:2, 2]
            u, v = np.arange(level.width) - centre[0], np.arange(level.height) - centre[1]
            corner = max(abs(u[0]), abs(u[-1])) ** 2 + max(abs(v[0]), abs(v[-1])) ** 2
            factor = 1 - barrel * (u**2 + v[:, None] ** 2) / corner
            maps: Any = cv2.convertMaps(
                (centre[0] + u * factor).astype(np.float32), (centre[1] + v[:, None] * factor).astype(np.float32), cv2.CV_16SC2
            )
            image = np.zeros_like(level.image)
            for u0, v0 in level.corner[: self.channels * self.n_frames].astype(int):
                own = slice(v0, v0 + level.height), slice(u0, u0 + level.width)
                image[own] = cv2.remap(level.image[own], maps[0], maps[1], cv2.INTER_LINEAR)
            return replace(level, image=image)

        out = self._with([undistorted(level) for level in self.levels])
        out._correlations = {}
        return out

    def _with(self, levels: list[AtlasLevel]) -> Atlas:
        out = copy.copy(self)
        out.levels = levels
        return out


def _laid_out(level: EdgeLevel, frames: int, channels: int, camera: Camera) -> AtlasLevel:
    """Room for so many maps (h, w) of all frames, in columns of tiles."""
    h, w = level.packed.shape[1:]
    per_column = max(MAX_SIDE // (h + PAD), 1)
    tiles = channels * frames
    columns = -(-tiles // per_column)
    if columns * (w + PAD) > MAX_SIDE:
        raise TooFewFeaturesError(
            f"{frames} frames of {w}x{h} do not fit one score; use fewer frames or a smaller image.max_width"
        )
    image = np.zeros((min(tiles, per_column) * (h + PAD) + PAD, columns * (w + PAD) + PAD), np.int16)
    corner = np.array([(PAD + t // per_column * (w + PAD), PAD + t % per_column * (h + PAD)) for t in range(tiles)], np.float32)
    scale, sigma = level.scale, level.sigma
    S = np.array([[1 / scale, 0, (1 / scale - 1) / 2], [0, 1 / scale, (1 / scale - 1) / 2], [0, 0, 1]])
    return AtlasLevel(image, corner, S @ camera.K, w, h, sigma / scale)

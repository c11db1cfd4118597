"""Scores of an extrinsic: points of all frames on maps of all images, which lie as tiles in one atlas per resolution."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.lens import angles_of_rays
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.sampler import MIN_DEPTH, Sampler

Map = NDArray[np.float32]
Pixels = NDArray[np.intp]


MARGIN = 0.28  # share of the image width; points that project no farther outside the image at the prior may come into view
MIN_POINTS = 200  # edge points of all frames together; fewer carry no extrinsic


class Score(Protocol):
    """A score of an extrinsic, to be maximised."""

    def value(self, T: Transform) -> float:
        """Score at T_camera_lidar (4, 4)."""


class SmoothScore(Score, Protocol):
    """A score that knows its slope."""

    def linearise(self, T: Transform) -> tuple[Matrix, Matrix]:
        """Gradient (6,) of the score by a left twist at T and a positive matrix (6, 6) that scales the step."""


def project(xyz: NDArray[np.float32], T: NDArray[np.float64], camera: Camera) -> tuple[Pixels, Pixels, Pixels]:
    """Points (n, 3) by T_camera_lidar (4, 4), eq. 2.30, on the nearest pixel of the pinhole `camera`.

    -> columns and rows (m,) of those in the image, and their indices into xyz (m,), ascending.
    """
    M = (camera.K @ T[:3]).astype(np.float32)
    p = M[:, :3] @ xyz.T + M[:, 3:]
    in_front = np.flatnonzero(p[2] > MIN_DEPTH)
    z = p[2, in_front]
    u, v = np.rint(p[0, in_front] / z), np.rint(p[1, in_front] / z)
    inside = np.flatnonzero((u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height))
    return u[inside].astype(np.intp), v[inside].astype(np.intp), in_front[inside]


def nearest_per_pixel(pixels: Pixels, points: Pixels, size: int) -> tuple[Pixels, Pixels]:
    """Flat pixels (m,) of points (m,), far ones first -> each pixel once with its last, that is nearest, point."""
    top = np.empty(size, np.intp)
    top[pixels] = np.arange(len(pixels))  # of repeated indices the last is written
    shown = np.flatnonzero(top[pixels] == np.arange(len(pixels)))
    return pixels[shown], points[shown]


def near_image(xyz: NDArray[np.float32], T: NDArray[np.float64], camera: Camera, margin: float) -> Pixels:
    """Indices of the points (n, 3) that project into the image or within margin * width around it, in front of the camera."""
    P = xyz @ T[:3, :3].T + T[:3, 3]
    depth = np.linalg.norm(P, axis=1) if camera.is_sphere else P[:, 2]
    in_front = np.flatnonzero(depth > MIN_DEPTH)  # of a full turn most are not
    P, K, border = P[in_front], camera.K, margin * camera.width
    x, y = (angles_of_rays(P) if camera.is_sphere else P[:, :2] / depth[in_front, None]).T
    u, v = K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]
    inside = (u > -border) & (u < camera.width + border) & (v > -border) & (v < camera.height + border)
    return np.asarray(in_front[inside])


class PointScore(Sampler):
    """Weighted mean of the map values under the points, at several resolutions.

    xyz: (3, n) float32 m, LiDAR frame, of several frames, frame after frame. weights: (n,) float32, sum up to 1. frame: (n,)
    number of the frame. channel: (n,) which of its maps is sampled.
    """

    def __init__(self, xyz: Map, weights: Map, frame: NDArray[np.int32], channel: NDArray[np.intp], atlas: Atlas) -> None:
        self.camera, self.n_frames, self.frame = atlas.camera, atlas.n_frames, frame
        super().__init__(xyz, weights, np.asarray(atlas.channels * frame + channel, np.int32), atlas)

    def _with(self, **changed: Any) -> PointScore:
        """The same with some attributes changed."""
        part = copy.copy(self)
        vars(part).update(changed)
        Sampler.__init__(part, part.points, part.weights, part._tiles, part.atlas)
        return part

    @property
    def n_levels(self) -> int:
        """Number of resolutions, coarse to fine."""
        return len(self.atlas.levels)

    @property
    def frames(self) -> NDArray[np.intp]:
        """Numbers of the frames that have points, ascending. By counting: sorting tens of thousands of numbers takes longer."""
        return np.flatnonzero(np.bincount(self.frame))

    def at(self, level: int) -> LevelScore:
        """The score at one resolution."""
        return LevelScore(self, level % self.n_levels)

    def select(self, keep: NDArray[np.intp] | NDArray[np.bool_]) -> PointScore:
        """The same on some of the points."""
        points, weights = np.ascontiguousarray(self.points[:, keep]), self.weights[keep] / self.weights[keep].sum()
        return self._with(points=points, frame=self.frame[keep], weights=weights, _tiles=self._tiles[keep])

    def mirrored(self) -> PointScore:
        """The same points on the maps mirrored left to right about the principal point: a decoy without any true alignment."""
        return self._with(atlas=self.atlas.mirrored())

    def on(self, atlas: Atlas) -> PointScore:
        """The same points on other maps of the same tiles."""
        return self._with(atlas=atlas)

    def with_points(self, xyz: NDArray[np.float32]) -> PointScore:
        """The same with its points elsewhere (3, n), m."""
        return self._with(points=xyz)

    def moved(self, twists: Matrix, seconds: float) -> PointScore:
        """The same points measured `seconds` later, from a LiDAR with these velocities (n_frames, 6), rad/s and m/s."""
        points = np.empty_like(self.points)
        ends = np.searchsorted(self.frame, np.arange(len(twists) + 1))  # frame after frame
        for j, motion in enumerate(se3.exp_many(twists * seconds).astype(np.float32)):
            own = slice(ends[j], ends[j + 1])
            np.matmul(motion[:3, :3], self.points[:, own], out=points[:, own])
            points[:, own] += motion[:3, 3:]
        return self.with_points(points)

    def subset(self, n: int, rng: np.random.Generator) -> PointScore:
        """The same on n random points; itself if there are no more than n."""
        total = self.points.shape[1]
        return self if total <= n else self.select(np.sort(rng.choice(total, n, replace=False)))

    def frame_values(self, transforms: Matrix, level: int) -> Matrix:
        """`values` frame by frame (k, n_frames); NaN for a frame without points."""
        present = self.frames
        first = np.searchsorted(self.frame, present)
        out = np.full((len(transforms), self.n_frames), np.nan)
        share = np.bincount(self.frame, self.weights, self.n_frames)[present]
        out[:, present] = self.group_values(transforms, level, first) / share
        return out

    def frame_scores(self, T: Transform, level: int = -1) -> Matrix:
        """Score of every frame alone (n_frames,); NaN for a frame without points."""
        e = self.samples(T, level % self.n_levels)
        weight = np.bincount(self.frame, self.weights, self.n_frames)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.bincount(self.frame, self.weights * e, self.n_frames) / weight)


@dataclass(frozen=True, eq=False)
class LevelScore:
    """PointScore at one resolution; a SmoothScore."""

    score: PointScore
    level: int

    def value(self, T: Transform) -> float:
        """Weighted mean of the map under the points."""
        return float(self.score.values(T[None], self.level)[0])

    def linearise(self, T: Transform) -> tuple[Matrix, Matrix]:
        """Gradient (6,) and the weighted outer product of the point derivatives (6, 6), the Gauss-Newton scale."""
        gradients, scales = self.score.linearise(T[None], self.level)
        return gradients[0], scales[0]

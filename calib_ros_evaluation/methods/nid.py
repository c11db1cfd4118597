"""Koide, Oishi, Yokozuka and Banno 2023, "General, single-shot, target-less, and automatic LiDAR-camera extrinsic calibration
toolbox": normalised information distance of reflectivity and grey value, its fine registration.

Both are histogram-equalised first. Points that nearer ones hide are left out, seen from where the search starts; the search,
a simplex, starts again from where it ended until it ends near there. Several frames: the mean of their distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from calib_ros import se3
from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.registration.score.point_score import project
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.optimizers import nelder_mead
from calib_ros_evaluation.methods.information import (
    enough,
    joint_counts,
    known_reflectivity,
    normalised_information_distance,
)
from calib_ros_evaluation.methods.method import Outcome, PointFeatures, Viewing, Watched, search_limits

Matrix = NDArray[np.float64]
BINS = 16  # published


@dataclass(frozen=True, eq=False)
class DistanceScore:
    """Less the mean of the frames' distances: -1, nothing in common, to 0. frames: with the points that are not hidden."""

    frames: Sequence[PointFeatures]

    def value(self, T: Matrix) -> float:
        """At T_camera_lidar (4, 4); a frame without a point in the image has a distance of 1."""
        return -float(np.mean([_distance(frame, T) for frame in self.frames]))


def _distance(frame: PointFeatures, T: Matrix) -> float:
    u, v, points = project(frame.xyz, T, frame.camera)
    counts = joint_counts(frame.value[points], frame.image[v, u], BINS)
    return normalised_information_distance(counts / len(points)) if len(points) else 1.0


def unhidden(frame: PointFeatures, T: Matrix, tolerance: float) -> NDArray[np.intp]:
    """Indices of the points in the image at T (4, 4) that are at most `tolerance` m farther from the camera than the
    nearest point of their pixel."""
    u, v, points = project(frame.xyz, T, frame.camera)
    distance = np.linalg.norm(frame.xyz[points] @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32), axis=1)
    pixel = v * frame.camera.width + u
    nearest = np.full(frame.camera.height * frame.camera.width, np.inf, np.float32)
    np.minimum.at(nearest, pixel, distance)
    return np.asarray(points[distance <= nearest[pixel] + tolerance])


@dataclass(frozen=True)
class Nid(Viewing):
    """Published: tolerance_m of what hides; starts and steps of the simplex, at most; settled, deg and m, is how near a
    search must end to where it began to be the last.

    step_share: size of the first simplex as a share of the reach; the published one suits a start that is as good as right.
    Nothing beyond the reach is tried, as in the published variant with slopes; the free simplex runs away on one scene.
    """

    config: Config = field(default_factory=Config)
    tolerance_m: float = 0.1
    starts: int = 10
    evaluations: int = 600  # 256 steps of one to three each; the tolerances end it long before
    settled: tuple[float, float] = (0.5, 0.1)
    step_share: float = 0.35
    name: str = "nid"
    title: str = "Koide et al. 2023: normalised information distance of reflectivity and grey value"

    def features(self, frame: Frame) -> PointFeatures:
        """All points and their equalised reflectivity. BadInputError if the cloud has none, TooFewFeaturesError if it is empty.

        Equalised is the rank among all points of the cloud. Points of the same reflectivity share their mean rank: where the
        sensor gives few values, ranks by order alone would tell where a point stands in the scan.
        """
        view, _, known = self._preprocess(frame)
        rank = (rankdata(known_reflectivity(known, frame.name)) - 0.5) / len(view.xyz)
        shade = np.minimum(np.arange(256) * BINS // 255, BINS - 1).astype(np.uint8)
        return replace(view, image=shade[cv2.equalizeHist(view.image)], value=(rank * BINS).astype(np.intp))

    def score(self, features: Sequence[PointFeatures], T_prior: Matrix) -> DistanceScore:
        """What is maximised while what is hidden stays as it is at T_prior (4, 4), and only points in its image count.

        TooFewFeaturesError if there is hardly any.
        """
        seen = [f.select(unhidden(f, T_prior, self.tolerance_m)) for f in features]
        return DistanceScore(enough(seen))

    def optimise(self, features: Sequence[PointFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """Nelder and Mead's simplex from T (4, 4), again and again; every search has its own score.

        A reach of zero refines: a small first simplex, no bounds.
        """
        watched = Watched(self.score(features, T))
        step = max(self.step_share * reach.reach[0], 0.1)
        limits = search_limits(T, reach)
        for _ in range(self.starts):
            found, _ = nelder_mead(watched, T, step, self.evaluations, limits=limits)
            near = se3.rotation_error_deg(T, found) < self.settled[0] and se3.translation_error_m(T, found) < self.settled[1]
            T = found
            if near:
                break
            watched.score = self.score(features, T)
        return Outcome(T, watched.evaluations)

"""Pandey, McBride, Savarese and Eustice 2012 and 2015: mutual information of reflectivity and grey value (thesis eq. 4.1).

Probabilities are kernel density estimates; steepest ascent with the step lengths of Barzilai and Borwein, as in both papers.
All points that fall into the image count: there is no test of what hides what.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from calib_ros.config import Config
from calib_ros.frame import Frame
from calib_ros.registration.score.point_score import MARGIN, near_image
from calib_ros.registration.score.sampler import MIN_DEPTH
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.optimizers import barzilai_borwein
from calib_ros_evaluation.methods.information import (
    density,
    enough,
    joint_counts,
    known_reflectivity,
    mutual_information,
    silverman_bandwidth,
)
from calib_ros_evaluation.methods.method import Outcome, PointFeatures, Viewing, Watched, search_limits

Matrix = NDArray[np.float64]
BINS = 256  # of both: the papers' lasers and cameras give 8 bits, and so do ours


@dataclass(frozen=True, eq=False)
class InformationScore:
    """Mutual information in nats of one joint histogram, into which the points of all frames go, as in the papers."""

    frames: Sequence[PointFeatures]

    def counts(self, T: Matrix) -> NDArray[np.intp]:
        """Joint histogram (BINS, BINS), reflectivity by grey value, at T_camera_lidar (4, 4)."""
        seen = [_seen(frame, T) for frame in self.frames]
        return joint_counts(np.concatenate([level for level, _ in seen]), np.concatenate([gray for _, gray in seen]), BINS)

    def value(self, T: Matrix) -> float:
        """At T (4, 4); 0 if no point falls into an image. The bandwidth is that of the points which do."""
        counts = self.counts(T)
        return mutual_information(density(counts, silverman_bandwidth(counts))) if counts.any() else 0.0


def _seen(frame: PointFeatures, T: Matrix) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Bins of the points in the image (m,): reflectivity, and the grey value between the four pixels around each.

    Bilinear, for the nearest pixel's value would not change while a point moves within the pixel, and the slope is taken by
    differences.
    """
    camera = frame.camera
    M = (camera.K @ T[:3]).astype(np.float32)
    p = M[:, :3] @ frame.xyz.T + M[:, 3:]
    in_front = np.flatnonzero(p[2] > MIN_DEPTH)
    z = p[2, in_front]
    u, v = p[0, in_front] / z, p[1, in_front] / z
    inside = np.flatnonzero((u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1))
    gray = map_coordinates(frame.image, (v[inside], u[inside]), np.float32, order=1, mode="nearest")
    return frame.value[in_front[inside]], np.rint(gray).astype(np.intp)


@dataclass(frozen=True)
class Pandey(Viewing):
    """What the papers leave open. step_share: first and longest step, as a share of the reach. epsilon_deg: half width of the
    central differences. evaluations: of the score, at most. Nothing beyond the reach is tried.
    """

    config: Config = field(default_factory=Config)
    step_share: float = 0.25
    epsilon_deg: float = 0.1
    evaluations: int = 400
    name: str = "pandey"
    title: str = "Pandey et al. 2015: mutual information of reflectivity and grey value"

    def features(self, frame: Frame) -> PointFeatures:
        """All points and their reflectivity. BadInputError if the cloud has none, TooFewFeaturesError if it is empty."""
        view, _, known = self._preprocess(frame)
        level = np.rint(known_reflectivity(known, frame.name) * np.float32(BINS - 1)).astype(np.intp)
        return replace(view, value=level)

    def score(self, features: Sequence[PointFeatures], T_prior: Matrix) -> InformationScore:
        """Mutual information over all frames. T_prior: (4, 4). TooFewFeaturesError if hardly a point is near the image."""
        return InformationScore(enough([f.select(near_image(f.xyz, T_prior, f.camera, MARGIN)) for f in features]))

    def optimise(self, features: Sequence[PointFeatures], T: Matrix, reach: SearchBox) -> Outcome:
        """Steepest ascent from T (4, 4), thesis eq. 3.13 and 3.14. A reach of zero refines: a short first step, no bounds."""
        watched = Watched(self.score(features, T))
        step = max(self.step_share * reach.reach[0], 2 * self.epsilon_deg)
        found, _ = barzilai_borwein(watched, T, step, self.epsilon_deg, self.evaluations, search_limits(T, reach))
        return Outcome(found, watched.evaluations)

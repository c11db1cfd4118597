"""Methods that compare reflectivity with grey values, by information measures of their joint histogram, in nats.

Pandey, McBride, Savarese and Eustice 2012 and 2015: mutual information (thesis eq. 4.1). Probabilities are kernel density
estimates; steepest ascent with the step lengths of Barzilai and Borwein, as in both papers. All points that fall into the image
count: there is no test of what hides what.

Koide, Oishi, Yokozuka and Banno 2023, "General, single-shot, target-less, and automatic LiDAR-camera extrinsic calibration
toolbox": normalised information distance, its fine registration. Both are histogram-equalised first. Points that nearer ones
hide are left out, seen from where the search starts; the search, a simplex, starts again from where it ended until it ends near
there. Several frames: the mean of their distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import entr
from scipy.stats import rankdata

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.registration.score.point_score import MARGIN, MIN_POINTS, near_image, project
from calib_ros.registration.score.sampler import MIN_DEPTH
from calib_ros.registration.search.constraints import SearchBox
from calib_ros.registration.search.optimizers import barzilai_borwein, nelder_mead
from calib_ros_evaluation.methods.method import MeanScore, Outcome, PointFeatures, Viewing, Watched, require, search_limits

Matrix = NDArray[np.float64]
PANDEY_BINS = 256  # of both: the papers' lasers and cameras give 8 bits, and so do ours
NID_BINS = 16  # published
TAIL = 4  # standard deviations; a Gaussian kernel is cut off where 6e-5 of its mass is left


def joint_counts(rows: NDArray[np.integer], columns: NDArray[np.integer], bins: int) -> NDArray[np.intp]:
    """How often each pair of bins occurs (bins, bins); rows, columns: (n,) numbers of bins from 0."""
    return np.bincount(rows * bins + columns, minlength=bins * bins).reshape(bins, bins)


def entropy(p: Matrix) -> float:
    """-sum p ln p of probabilities of any shape that sum to 1."""
    return float(entr(p).sum())


def mutual_information(joint: Matrix) -> float:
    """MI(x, y) = H(x) + H(y) - H(x, y) of joint probabilities (rows, columns) that sum to 1; from 0, independent, on."""
    return entropy(joint.sum(axis=1)) + entropy(joint.sum(axis=0)) - entropy(joint)


def normalised_information_distance(joint: Matrix) -> float:
    """NID = 1 - MI(x, y) / H(x, y) (Li et al. 2004): 0 if one determines the other, 1 if independent or nothing varies."""
    both = entropy(joint)
    return 1 - mutual_information(joint) / both if both > 0 else 1.0


def silverman_bandwidth(counts: NDArray[np.number]) -> tuple[float, float]:
    """Standard deviations along rows and columns, in bins, of the product kernel that Silverman's rule gives a histogram.

    h = s n^(-1/6) with the data's own standard deviation s: his factor (4 / (d + 2))^(1 / (d + 4)) is 1 for d = 2.
    """
    n, bins = float(counts.sum()), np.arange(max(counts.shape))
    widths = []
    for axis in (1, 0):
        p, x = counts.sum(axis=axis) / n, bins[: counts.shape[1 - axis]]
        widths.append(float(np.sqrt(p @ (x - p @ x) ** 2)) * n ** (-1 / 6))
    return widths[0], widths[1]


def density(counts: NDArray[np.number], bandwidth: tuple[float, float]) -> Matrix:
    """Kernel density estimate of joint probabilities, (rows, columns), sum 1: the histogram convolved with a Gaussian.

    bandwidth: along rows and columns, in bins. The histogram is mirrored at its ends, so that no mass leaves it; the marginals
    of the result are those of the histogram, smoothed alike.
    """
    kernels = []
    for h in bandwidth:
        r = int(np.ceil(TAIL * h))
        weight = np.exp(-0.5 * (np.arange(-r, r + 1) / max(h, 1e-9)) ** 2)
        kernels.append(np.asarray((weight / weight.sum())[:, None], np.float32))
    down, across = kernels
    smooth = cv2.sepFilter2D(counts.astype(np.float32), cv2.CV_32F, across, down, borderType=cv2.BORDER_REFLECT)
    return np.asarray(smooth / smooth.sum(dtype=np.float64), np.float64)


def known_reflectivity(view: PointFeatures, frame_name: str) -> NDArray[np.float32]:
    """Reflectivity (n,) of a frame's points, 0..1. BadInputError if it has none."""
    if view.value is None:
        raise BadInputError(
            f"frame {frame_name}: the cloud has no reflectivity, or the same everywhere, and this method compares nothing else; "
            "record the field intensity, or leave this method out"
        )
    return np.asarray(view.value)


def enough(features: list[PointFeatures]) -> list[PointFeatures]:
    """The same; TooFewFeaturesError if they have fewer than MIN_POINTS points in all."""
    advice = "check the initial extrinsic and that the LiDAR sees what the camera sees"
    require(sum(len(f.xyz) for f in features), MIN_POINTS, f"near the image in {len(features)} frames", advice)
    return features


@dataclass(frozen=True, eq=False)
class InformationScore:
    """Mutual information in nats of one joint histogram, into which the points of all frames go, as in the papers."""

    frames: Sequence[PointFeatures]

    def counts(self, T: Matrix) -> NDArray[np.intp]:
        """Joint histogram (PANDEY_BINS, PANDEY_BINS), reflectivity by grey value, at T_camera_lidar (4, 4)."""
        seen = [_seen(frame, T) for frame in self.frames]
        return joint_counts(np.concatenate([level for level, _ in seen]), np.concatenate([gray for _, gray in seen]), PANDEY_BINS)

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

    step_share: float = 0.25
    epsilon_deg: float = 0.1
    evaluations: int = 400
    name = "pandey"
    title = "Pandey et al. 2015: mutual information of reflectivity and grey value"

    def features(self, frame: Frame) -> PointFeatures:
        """All points and their reflectivity. BadInputError if the cloud has none, TooFewFeaturesError if it is empty."""
        view, _ = self._preprocess(frame)
        level = np.rint(known_reflectivity(view, frame.name) * np.float32(PANDEY_BINS - 1)).astype(np.intp)
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


def likeness(frame: PointFeatures, T: Matrix) -> float:
    """Less the distance of a frame at T_camera_lidar (4, 4): -1, nothing in common or no point in the image, to 0."""
    u, v, points = project(frame.xyz, T, frame.camera)
    counts = joint_counts(frame.value[points], frame.image[v, u], NID_BINS)
    return -normalised_information_distance(counts / len(points)) if len(points) else -1.0


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

    tolerance_m: float = 0.1
    starts: int = 10
    evaluations: int = 600  # 256 steps of one to three each; the tolerances end it long before
    settled: tuple[float, float] = (0.5, 0.1)
    step_share: float = 0.35
    name = "nid"
    title = "Koide et al. 2023: normalised information distance of reflectivity and grey value"

    def features(self, frame: Frame) -> PointFeatures:
        """All points and their equalised reflectivity. BadInputError if the cloud has none, TooFewFeaturesError if it is empty.

        Equalised is the rank among all points of the cloud. Points of the same reflectivity share their mean rank: where the
        sensor gives few values, ranks by order alone would tell where a point stands in the scan.
        """
        view, _ = self._preprocess(frame)
        rank = (rankdata(known_reflectivity(view, frame.name)) - 0.5) / len(view.xyz)
        shade = np.minimum(np.arange(256) * NID_BINS // 255, NID_BINS - 1).astype(np.uint8)
        return replace(view, image=shade[cv2.equalizeHist(view.image)], value=(rank * NID_BINS).astype(np.intp))

    def score(self, features: Sequence[PointFeatures], T_prior: Matrix) -> MeanScore:
        """What is maximised while what is hidden stays as it is at T_prior (4, 4), and only points in its image count.

        TooFewFeaturesError if there is hardly any.
        """
        seen = [f.select(unhidden(f, T_prior, self.tolerance_m)) for f in features]
        return MeanScore(enough(seen), likeness)

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

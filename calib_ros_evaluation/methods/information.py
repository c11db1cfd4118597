"""Information measures of a joint histogram of reflectivity and grey value, in nats."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import entr

from calib_ros.errors import BadInputError
from calib_ros.registration.score.point_score import MIN_POINTS
from calib_ros_evaluation.methods.method import PointFeatures, require

Matrix = NDArray[np.float64]
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
    down, across = (_kernel(h) for h in bandwidth)
    smooth = cv2.sepFilter2D(counts.astype(np.float32), cv2.CV_32F, across, down, borderType=cv2.BORDER_REFLECT)
    return np.asarray(smooth / smooth.sum(dtype=np.float64), np.float64)


def _kernel(bandwidth: float) -> NDArray[np.float32]:
    """Gaussian (2 r + 1, 1) of a standard deviation in bins, sum 1."""
    r = int(np.ceil(TAIL * bandwidth))
    weight = np.exp(-0.5 * (np.arange(-r, r + 1) / max(bandwidth, 1e-9)) ** 2)
    return np.asarray((weight / weight.sum())[:, None], np.float32)


def known_reflectivity(known: NDArray[np.float32] | None, frame_name: str) -> NDArray[np.float32]:
    """Reflectivity (n,) of a frame's points, 0..1. BadInputError if it has none."""
    if known is None:
        raise BadInputError(
            f"frame {frame_name}: the cloud has no reflectivity, or the same everywhere, and this method compares nothing else; "
            "record the field intensity, or leave this method out"
        )
    return known


def enough(features: list[PointFeatures]) -> list[PointFeatures]:
    """The same; TooFewFeaturesError if they have fewer than MIN_POINTS points in all."""
    advice = "check the initial extrinsic and that the LiDAR sees what the camera sees"
    require(sum(len(f.xyz) for f in features), MIN_POINTS, f"near the image in {len(features)} frames", advice)
    return features

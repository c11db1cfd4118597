"""Is an optimum a calibration, or only the best of many chance alignments?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calib_ros import se3
from calib_ros.registration.point_score import PointScore

MIN_SCORE = 0.15  # a search in pictures of noise finds 0.05-0.15; calibrations score 0.23-1.3 (KITTI from 1 frame, synthetic)
NEIGHBOURS = 128
HALF_WIDTH = np.array([np.deg2rad(6.0)] * 3 + [0.5] * 3)  # rad, m; edges move by tens of pixels: nothing matches but by chance
POINTS = 15000  # edge points used, so that many frames do not cost more


def distinctness(score: PointScore, T: NDArray[np.float64]) -> float:
    """The score at T (4, 4) over the 99th percentile of the scores of extrinsics spread around it; no unit.

    Unlike the score itself it compares across scenes and sensors: a picture full of edges scores high anywhere. Measured
    with 3 and more frames on KITTI and synthetic streets of 16 and 64 rings: calibrations 2.0 to 4.0, the best optimum for
    images of other scenes or looking elsewhere 1.1 to 2.0 (with 6 and more frames 2.4 to 4.0 against 1.1 to 1.9).
    """
    level = score.subset(POINTS, np.random.default_rng(0)).at(-1)
    spread = qmc.Sobol(6, seed=0).random(NEIGHBOURS) * 2 - 1
    around = [level.value(se3.exp(x * HALF_WIDTH) @ T) for x in spread]
    return level.value(T) / max(float(np.percentile(around, 99)), 1e-3)

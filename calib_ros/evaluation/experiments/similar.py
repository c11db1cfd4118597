"""How alike the frames of a drive are, and which become keyframes (figures 3.22, 3.23, algorithm 6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros.evaluation.experiments.world import World
from calib_ros.evaluation.trials.job import Answer, Job
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online.keyframes import KeyframeSelector, histogram, similarity

SHOWN_HISTOGRAMS = 4
BINS = 64  # of a drawn histogram
THESIS_THRESHOLD = 0.7  # section 3.6


def similarity_of_frames(world: World, job: Job) -> Answer:
    """Matrix of eq. 3.15; keyframes of algorithm 6 at the thesis's threshold and at the configured one, and the node's."""
    config = world.config.online
    frames = [_Picture(world.frame(job.scene, position)) for position in job.frames]
    own = [frame.histogram for frame in frames]
    matrix = np.array([[similarity(a, b) for b in own] for a in own])
    selector = KeyframeSelector(config)
    online = [k for k, frame in enumerate(frames) if selector.offer_histogram(frame.histogram, frame.stamp)]
    thresholds = sorted({THESIS_THRESHOLD, config.similarity_threshold})
    shown = np.unique(np.linspace(0, len(frames) - 1, min(SHOWN_HISTOGRAMS, len(frames))).round().astype(int))
    return {
        "names": [frame.name for frame in frames],
        "stamps": [(frame.stamp - frames[0].stamp) / NANOSECONDS for frame in frames],
        "matrix": matrix.tolist(),
        "keyframes": [[threshold, algorithm_6(matrix, threshold)] for threshold in thresholds],
        "online": online,
        "online_threshold": config.similarity_threshold,
        "histograms": {frames[k].name: own[k].reshape(len(own[k]), BINS, -1).sum(axis=2).tolist() for k in shown},
    }


def algorithm_6(matrix: NDArray[np.float64], threshold: float) -> list[int]:
    """Positions of the frames that algorithm 6 selects, the first among them; matrix (n, n): similarities."""
    chosen = [0]
    for k in range(1, len(matrix)):
        if matrix[chosen[-1], k] < threshold:
            chosen.append(k)
    return chosen


class _Picture:
    """What is kept of a frame: images of a whole drive would not fit into memory."""

    def __init__(self, frame: Frame) -> None:
        self.name, self.stamp, self.histogram = frame.name or str(frame.stamp), frame.stamp, histogram(frame.image)

"""How alike the frames of a drive are, and which become keyframes (figures 3.22, 3.23, algorithm 6)."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.frame import NANOSECONDS, Frame
from calib_ros.online.keyframes import KeyframeSelector, histogram, similarity
from calib_ros.registration.score import Score
from calib_ros_evaluation.experiments.setup import WorkerCache
from calib_ros_evaluation.trials.journal import Answer, Job

SHOWN_HISTOGRAMS = 4
BINS = 64  # of a drawn histogram
THESIS_THRESHOLD = 0.7  # section 3.6


def similarity_of_frames(cache: WorkerCache, job: Job) -> Answer:
    """Matrix of eq. 3.15; keyframes of algorithm 6 at the thesis's threshold and at the configured one, and the node's."""
    config = cache.config.online
    frames = [_Picture(cache.frame(job.scene, position)) for position in job.frames]
    own = [frame.histogram for frame in frames]
    matrix = np.array([[similarity(a, b) for b in own] for a in own])
    selector = KeyframeSelector(config)
    online = [k for k, frame in enumerate(frames) if selector.select_histogram(frame.histogram, frame.stamp)]
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


# What a method costs: CPU time of features and of one evaluation, and the memory that its arrays take.
Matrix = NDArray[np.float64]
BATCHES, EVALUATIONS = 7, 10  # the middle batch counts; the clock of CPU time is too coarse for one evaluation
LONGEST_S = 0.5  # of a batch: a slow score is evaluated less often
SPREAD = np.repeat([np.deg2rad(0.5), 0.05], 3)  # rad, m; where it is evaluated, around the reference


def cost(cache: WorkerCache, job: Job) -> Answer:
    """Features are made anew for each frame; the first frame does not count, it pays for look-up tables and imports."""
    method, T = cache.methods[job.method], cache.reference(job.scene, job.frames[0])
    frames = [cache.frame(job.scene, position) for position in job.frames]
    method.score([method.features(frames[0])], T).value(T)
    spent, made = [], []
    for frame in frames:
        started = time.process_time()
        made.append(method.features(frame))
        spent.append(time.process_time() - started)
    score, rng = method.score(made, T), np.random.default_rng(0)
    around = [se3.exp(rng.uniform(-1, 1, 6) * SPREAD) @ T for _ in range(EVALUATIONS)]
    times = [_batch(score, around) for _ in range(BATCHES)]
    return {
        "features_ms_per_frame": 1000 * float(np.median(spent)),
        "evaluation_ms": 1000 * float(np.median(times)),
        "memory_mb": _memory(cache, job),
    }


def _batch(score: Score, around: list[Matrix]) -> float:
    """CPU s of an evaluation, mean of as many as fit into LONGEST_S."""
    started, spent, done = time.process_time(), 0.0, 0
    while done < len(around) and spent < LONGEST_S:
        score.value(around[done])
        done, spent = done + 1, time.process_time() - started
    return spent / done


def _memory(cache: WorkerCache, job: Job) -> float:
    """Peak of all arrays while one after another is made, MB; numpy reports its own, and those that OpenCV gets from it."""
    method, T = cache.methods[job.method], cache.reference(job.scene, job.frames[0])
    frames = [cache.frame(job.scene, position) for position in job.frames]
    tracemalloc.start()
    try:
        method.score([method.features(frame) for frame in frames], T).value(T)
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()

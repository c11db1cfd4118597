"""Several frames of a drive (section 3.6): weights of their scores, their similarity, and which become keyframes."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config, SemanticsConfig
from calib_ros.config.semantics import GEOMETRIC
from calib_ros.errors import CalibrationError
from calib_ros.frame import MAIN_CLASSES, NANOSECONDS, UNLABELLED, Frame
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.online.keyframes import KeyframeSelector, histogram, similarity
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.curves import Curves, curves
from calib_ros_evaluation.experiments.job import EvaluationJob, job
from calib_ros_evaluation.experiments.scores import label
from calib_ros_evaluation.experiments.setup import WorkerCache
from calib_ros_semantics.models.segmentation import SegmentationModels
from calib_ros_thesis.features import importance

Matrix = NDArray[np.float64]
SET = 3  # frames averaged, as in figure 4.16
MAX_SETS = 400
AROUND_PX = 5  # a point stands for so many pixels each way: the spacing of a 64-ring scanner's points at KITTI's focal length
SHOWN_HISTOGRAMS = 4
BINS = 64  # of a drawn histogram
THESIS_THRESHOLD = 0.7  # of similarity (section 3.6)


def averaging(cache: WorkerCache, one: EvaluationJob) -> Answer:
    """Curves of single frames and of their averages; and over many sets of frames, how far the peaks of both averages lie off."""
    weights, source = importances(cache, one)
    frames = [position for position, w in zip(one.frames, weights, strict=True) if w is not None]
    w = np.array([x for x in weights if x is not None])
    if len(frames) < SET:
        raise CalibrationError(f"{one.scene}: averaging needs {SET} frames with classes, there are {len(frames)}")
    single = [_curves(cache, one, position) for position in frames]
    sets = np.array(list(combinations(range(len(frames)), SET)))
    if len(sets) > MAX_SETS:
        sets = sets[np.sort(np.random.default_rng(0).choice(len(sets), MAX_SETS, replace=False))]
    distances = [[np.abs(average(single, v, own).peaks).tolist() for v in (w, np.ones(len(w)))] for own in sets]
    order = np.argsort(w, kind="stable")
    shown = [int(k) for k in (order[0], order[len(order) // 2], order[-1])]  # the least, the middle and the most important
    return {
        "labels": [label(cache, job("", "", one.scene, [frames[k]])) for k in shown],
        "weights": w[shown].tolist(),
        "offsets": single[0].offsets.tolist(),
        "single": [single[k].values.tolist() for k in shown],
        "weighted": average(single, w, shown).values.tolist(),
        "unweighted": average(single, np.ones(len(w)), shown).values.tolist(),
        "distances": distances,
        "classes": source,
    }


def average(single: list[Curves], w: Matrix, chosen: list[int] | NDArray[np.intp]) -> Curves:
    """Eq. 3.16 along the axes: J is linear in the frames' J_j, and so are its curves. All weights 0 count as all alike."""
    own = w[chosen] if w[chosen].any() else np.ones(len(chosen))
    values = np.tensordot(own / own.sum(), np.stack([single[k].values for k in chosen]), 1)
    return Curves(single[0].offsets, values)


def importances(cache: WorkerCache, one: EvaluationJob) -> tuple[list[float | None], str]:
    """w_j of each frame, None where no class is known, and where the classes come from."""
    config = cache.config.semantics
    segmentation = SegmentationModels(config)
    if segmentation.missing("image_classes") == "":
        out: list[float | None] = []
        for position in one.frames:
            seen = segmentation(cache.frame(one.scene, position))
            out.append(None if seen.classes is None else importance(seen.classes))
        return out, "pixels, by semantics.image_classes"
    geometric = SegmentationModels(SemanticsConfig(cloud_classes=GEOMETRIC))
    shares = []
    for position in one.frames:
        frame = cache.frame(one.scene, position)
        shares.append(share_of_points(frame, geometric(frame).labels, cache.reference(one.scene, position), cache.config))
    source = (
        "points that the reference projects into the picture, classified by their shape; no model of image classes is configured"
    )
    return shares, source


def share_of_points(frame: Frame, labels: NDArray[np.uint8] | None, T: Matrix, config: Config) -> float | None:
    """w_j from labelled points (n,): of the pixels around those that T_camera_lidar (4, 4) projects into the picture, the share
    of main classes; None if no class is known."""
    if labels is None:
        return None
    xyz = deskewed_frame(frame, config.motion).cloud.xyz
    P = xyz @ T[:3, :3].T + T[:3, 3]
    uv, inside = frame.camera.project(P)
    known = np.flatnonzero(inside & (labels != UNLABELLED))
    if not len(known):
        return None
    of_main = np.isin(labels, MAIN_CLASSES)
    main, other = (_nearness(P, uv, known[of_main[known] == kind], frame) for kind in (True, False))
    return float((main > other).sum() / ((main > 0) | (other > 0)).sum())


def _nearness(P: Matrix, uv: Matrix, points: NDArray[np.intp], frame: Frame) -> NDArray[np.float32]:
    """1 / z of the nearest of these points around each pixel (h, w), 0 without one: near surfaces hide far ones."""
    out = np.zeros(frame.image.shape[:2], np.float32)
    u, v = np.rint(uv[points]).astype(int).T
    np.maximum.at(out, (v, u), (1 / P[points, 2]).astype(np.float32))
    return np.asarray(cv2.dilate(out, np.ones((AROUND_PX, AROUND_PX), np.uint8)), np.float32)


def _curves(cache: WorkerCache, one: EvaluationJob, position: int) -> Curves:
    features, _ = cache.features(one.method, one.scene, position)
    reference = cache.reference(one.scene, position)
    score = cache.methods[one.method].score([features], reference)
    return curves(score, reference, one.option("deg"), one.option("m"), one.option("samples"))


def similarity_of_frames(cache: WorkerCache, job: EvaluationJob) -> Answer:
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

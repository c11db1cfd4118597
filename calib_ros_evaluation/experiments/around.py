"""Scores around the reference: along the six axes, and over two of them."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config, SemanticsConfig
from calib_ros.config.semantics import GEOMETRIC
from calib_ros.errors import CalibrationError
from calib_ros.frame import MAIN_CLASSES, UNLABELLED, Frame
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.registration.features import importance
from calib_ros.registration.score import Score
from calib_ros.semantics.segmentation import Segmentation
from calib_ros_evaluation.curves import Curves, curves
from calib_ros_evaluation.experiments.setup import WorkerCache
from calib_ros_evaluation.trials.journal import Answer, Job, job


def loss_curves(cache: WorkerCache, job: Job) -> Answer:
    """Curves over the six axes (figures 4.7, 4.10, 4.13)."""
    score = _score(cache, job)
    reference = cache.reference(job.scene, job.frames[0])
    found = curves(score, reference, job.option("deg"), job.option("m"), job.option("samples"))
    return {"label": label(cache, job), "offsets": found.offsets.tolist(), "values": found.values.tolist()}


def heat_map(cache: WorkerCache, job: Job) -> Answer:
    """Scores over two axes (figures 3.17, 3.18)."""
    score, reference = _score(cache, job), cache.reference(job.scene, job.frames[0])
    axes = [int(job.option("first")), int(job.option("second"))]
    unit = np.linspace(-1, 1, job.option("samples"))
    half = np.repeat([np.deg2rad(job.option("deg")), job.option("m")], 3)
    shown = np.repeat([job.option("deg"), 100 * job.option("m")], 3)
    E = np.diag(half)[axes]
    values = [[score.value(se3.exp(x * E[0] + y * E[1]) @ reference) for x in unit] for y in unit]
    offsets = {"x": (unit * shown[axes[0]]).tolist(), "y": (unit * shown[axes[1]]).tolist()}
    return {"label": label(cache, job), "values": values, **offsets}


def label(cache: WorkerCache, job: Job) -> str:
    """Name of a job's frames for people."""
    names = [cache.frame(job.scene, position).name or str(position) for position in job.frames]
    return f"{job.scene}, {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"


def _score(cache: WorkerCache, job: Job) -> Score:
    features = [cache.features(job.method, job.scene, position)[0] for position in job.frames]
    return cache.methods[job.method].score(features, cache.reference(job.scene, job.frames[0]))


# Weighted against unweighted averaging over frames (eq. 3.16, figure 4.16).
Matrix = NDArray[np.float64]
SET = 3  # frames averaged, as in figure 4.16
MAX_SETS = 400
AROUND_PX = 5  # a point stands for so many pixels each way: the spacing of a 64-ring scanner's points at KITTI's focal length


def averaging(cache: WorkerCache, one: Job) -> Answer:
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


def importances(cache: WorkerCache, one: Job) -> tuple[list[float | None], str]:
    """w_j of each frame, None where no class is known, and where the classes come from."""
    config = cache.config.semantics
    segmentation = Segmentation(config)
    if segmentation.missing("image_classes") == "":
        out: list[float | None] = []
        for position in one.frames:
            seen = segmentation(cache.frame(one.scene, position))
            out.append(None if seen.classes is None else importance(seen.classes))
        return out, "pixels, by semantics.image_classes"
    geometric = Segmentation(SemanticsConfig(cloud_classes=GEOMETRIC))
    shares = []
    for position in one.frames:
        frame = cache.frame(one.scene, position)
        shares.append(share_of_points(frame, geometric(frame).labels, cache.reference(one.scene, position), cache.config))
    said = "points that the reference projects into the picture, told by their shape; no model of image classes is configured"
    return shares, said


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


def _curves(cache: WorkerCache, one: Job, position: int) -> Curves:
    features, _ = cache.features(one.method, one.scene, position)
    reference = cache.reference(one.scene, position)
    score = cache.methods[one.method].score([features], reference)
    return curves(score, reference, one.option("deg"), one.option("m"), one.option("samples"))

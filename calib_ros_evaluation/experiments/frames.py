"""Several frames of a drive (section 3.6): what weights of their scores do, and how alike they are."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.config import Config, SemanticsConfig
from calib_ros.config.semantics import GEOMETRIC
from calib_ros.frame import UNLABELLED, Frame, SemanticClass
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.online.keyframes import histogram, similarity
from calib_ros.registration.classes import CLOUD, IMAGE
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.experiments.job import EvaluationJob
from calib_ros_evaluation.experiments.setup import WorkerCache, spread
from calib_ros_evaluation.experiments.trial import loss_curves
from calib_ros_semantics.models.segmentation import SegmentationModels
from calib_ros_thesis.features import importance

Matrix = NDArray[np.float64]
Classes = NDArray[np.uint8]
AROUND = np.arange(-2, 3)  # px that a point stands for: the spacing of a 64-ring scanner's points at KITTI's focal length
MOST_HISTOGRAMS, BINS = 4, 64  # drawn, and of each


def averaging(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """Name of each frame, its w_j of eq. 3.16, its shares of all classes, and its curves."""
    models, shapes = (SegmentationModels(c) for c in (cache.config.semantics, SemanticsConfig(cloud_classes=GEOMETRIC)))
    frames, source, found = list[tuple[Any, ...]](), "by semantics.image_classes", Answer()
    for position in job.frames:
        frame = cache.frame(job.scene, position)
        classes = models(frame, kinds=(IMAGE,)).classes
        if classes is None:
            source = "around points, classified by their shape, where semantics.image_classes gives none"
            labels = shapes(frame, kinds=(CLOUD,)).labels
            classes = classes_of_points(frame, labels, cache.reference(job.scene, position), cache.config)
        count = np.bincount(classes.ravel(), minlength=len(SemanticClass))[: len(SemanticClass)]
        found = loss_curves(cache, replace(job, frames=(position,)))
        shares = (count / max(count.sum(), 1)).tolist()
        frames.append((frame.name or str(position), importance(classes) or 0.0, shares, found["values"]))
    return {"frames": frames, "offsets": found["offsets"], "classes_of": source}


def classes_of_points(frame: Frame, labels: Classes | None, T: Matrix, config: Config) -> Classes:
    """Classes (h, w) of the pixels around points with labels (n,) that T_camera_lidar (4, 4) projects into the image; near points
    hide far ones. labels: None = unknown."""
    h, w = frame.image.shape[:2]
    out = np.full((h, w), UNLABELLED, np.uint8)
    if labels is None:
        return out
    P = deskewed_frame(frame, config.motion).cloud.xyz @ T[:3, :3].T + T[:3, 3]
    uv, inside = frame.camera.project(P)
    known = np.flatnonzero(inside & (labels != UNLABELLED))
    known = known[np.argsort(-np.linalg.norm(P[known], axis=1))]  # of several values for a pixel the last one stays
    at = np.rint(uv[known]).astype(int)[..., None, None]
    out[np.clip(at[:, 1] + AROUND[:, None], 0, h - 1), np.clip(at[:, 0] + AROUND, 0, w - 1)] = labels[known, None, None]
    return out


def similarities(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """Eq. 3.15 of every two frames, and the histograms of some."""
    found = [histogram(cache.frame(job.scene, position).image) for position in job.frames]
    shown = spread(range(len(found)), MOST_HISTOGRAMS)
    return {
        "matrix": [[similarity(a, b) for b in found] for a in found],
        "threshold": cache.config.online.similarity_threshold,
        "histograms": {job.frames[k]: found[k].reshape(len(found[k]), BINS, -1).sum(axis=2).tolist() for k in shown},
    }

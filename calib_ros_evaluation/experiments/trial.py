"""What is measured: of a method calibrations from wrong starts, its score around the reference and its cost; of several frames
of a drive (section 3.6) what weights of their scores do, and how alike they are."""

from __future__ import annotations

import contextlib
import time
import tracemalloc
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.config import Config, SemanticsConfig
from calib_ros.config.semantics import GEOMETRIC
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.frame import UNLABELLED, Frame, SemanticClass
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.online.keyframes import histogram, similarity
from calib_ros.registration.classes import CLOUD, IMAGE
from calib_ros.registration.score.point_score import Score
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_check.jobs.pool import Answer
from calib_ros_check.outcome import CheckVerdict
from calib_ros_evaluation.curves import curves
from calib_ros_evaluation.experiments.setup import NOT_THE_METHODS, Setup, WorkerCache, spread, worker_cache
from calib_ros_evaluation.methods.edges import LevinsonScore, worse_share
from calib_ros_evaluation.protocols.definitions import MISCALIBRATION, PROTOCOLS, TOLERANCE, Size, displacement
from calib_ros_evaluation.results import OF_TRIALS, EvaluationJob
from calib_ros_semantics.models.segmentation import SegmentationModels
from calib_ros_thesis.features import importance

Matrix = NDArray[np.float64]
BATCHES, EVALUATIONS = 7, 10  # the middle batch counts; the clock of CPU time is too coarse for one evaluation
LONGEST_S = 0.5  # of a batch: a slow score is evaluated less often
SPREAD = np.repeat([np.deg2rad(0.5), 0.05], 3)  # rad, m; around the reference, where the score is evaluated for its cost
# Errors that `trust` compares with none, deg and m: a turn about, and a shift along, a direction that the seed draws.
ERRORS = ((0.25, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.05), (0.0, 0.1), (0.0, 0.2))
DIRECTIONS = 8
Classes = NDArray[np.uint8]
AROUND = np.arange(-2, 3)  # px that a point stands for: the spacing of a 64-ring scanner's points at KITTI's focal length
MOST_HISTOGRAMS, BINS = 4, 64  # drawn, and of each


def wrong_start(T: Matrix, job: EvaluationJob) -> Matrix:
    """T_camera_lidar (4, 4) of a trial: off by a left twist, uniform in +- start_deg and +- start_m per axis, or as a published
    protocol says.

    The direction depends on scene, frames and seed alone: all methods begin at the same place, and at larger sizes farther along
    the same way. Of a protocol it is the same for any number of frames, so that these are compared on alike starts.
    """
    seed = [int(job.option("seed")), zlib.crc32(job.scene.encode())]
    if job.experiment in PROTOCOLS:
        size = Size(job.option("start_deg"), job.option("start_m"))
        return PROTOCOLS[job.experiment].start(T, size, np.random.default_rng(seed))
    rng = np.random.default_rng([*seed, *job.frames])
    half = np.repeat([np.deg2rad(job.option("start_deg")), job.option("start_m")], 3)
    return se3.exp(rng.uniform(-1, 1, 6) * half) @ T


def trial(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """One calibration from `wrong_start`, searched as far as the job's start_deg and start_m. A method that fails gives an
    answer with the reason; NOT_THE_METHODS is raised."""
    reference = cache.reference(job.scene, job.frames[0])
    start = wrong_start(reference, job)
    answer: Answer = {"status": "done", "reason": "", "start": off(start, reference)}
    answer["start_rotation_deg"], answer["start_translation_m"] = se3.error(reference, start)
    answer |= _end(start, reference)
    answer |= dict.fromkeys(("score_start", "score_end", "score_reference"))
    answer |= {"evaluations": 0, "cpu_s": 0.0, "features_cpu_s": 0.0}
    try:
        made = [cache.features(job.method, job.scene, position) for position in job.frames]
        answer["features_cpu_s"] = sum(cpu for _, cpu in made)
        features, method = [own for own, _ in made], cache.methods[job.method]
        reach = SearchBox(job.option("start_deg"), job.option("start_m"))
        started = time.process_time()
        found = method.optimise(features, start, reach)
        answer["cpu_s"] = time.process_time() - started
    except NOT_THE_METHODS:
        raise
    except CalibrationError as error:
        return answer | {"status": "failed", "reason": str(error)}
    answer |= {**_end(found.T, reference), "evaluations": found.evaluations}
    # Of one and the same points, else they would not be comparable; NaN where hardly any is near the image at the reference.
    with contextlib.suppress(CalibrationError):
        score = method.score(features, reference)
        answer |= {f"score_{name}": score.value(T) for name, T in (("start", start), ("end", found.T), ("reference", reference))}
    if found.refused:
        answer |= {"status": "refused", "reason": found.refused}
    return answer


def _end(T: Matrix, reference: Matrix) -> Answer:
    deg, m = se3.error(reference, T)
    return {"end": off(T, reference), "rotation_deg": deg, "translation_m": m}


def off(T: Matrix, reference: Matrix) -> list[float]:
    """Twist (6,) of T against the reference in the camera frame, deg and m."""
    xi = se3.log(T @ se3.inverse(reference))
    return [*np.rad2deg(xi[:3]).tolist(), *xi[3:].tolist()]


def checked(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """The verdict of the check on a row of the published perturbations; where it cannot use its frames, it does not tell."""
    reference = cache.reference(job.scene, job.frames[0])
    T = reference @ displacement(dict(job.options))
    answer: Answer = dict(zip(("error_deg", "error_m"), se3.error(reference, T), strict=True))
    try:
        result = cache.checker(job.scene).check([cache.frame(job.scene, k) for k in job.frames], T, TOLERANCE)
    except NOT_THE_METHODS:
        raise
    except CalibrationError as error:
        return answer | {"verdict": CheckVerdict.INCONCLUSIVE.value, "reason": str(error), "cpu_s": 0.0}
    return answer | {"verdict": result.verdict.value, "reason": result.reason, "cpu_s": result.cpu_s}


def cost(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """CPU time of features and of one evaluation, and memory. The first frame does not count: it pays for imports and look-up
    tables."""
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
    times = []  # CPU s of an evaluation, mean of as many as fit into LONGEST_S
    for _ in range(BATCHES):
        started, used, done = time.process_time(), 0.0, 0
        while done < len(around) and used < LONGEST_S:
            score.value(around[done])
            done, used = done + 1, time.process_time() - started
        times.append(used / done)
    tracemalloc.start()
    try:
        method.score([method.features(frame) for frame in frames], T).value(T)
        peak = tracemalloc.get_traced_memory()[1]  # of all arrays; numpy reports its own, and those that OpenCV allocates by it
    finally:
        tracemalloc.stop()
    return {
        "features_ms_per_frame": 1000 * float(np.median(spent)),
        "evaluation_ms": 1000 * float(np.median(times)),
        "memory_mb": peak / 1e6,
    }


def loss_curves(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """Curves over the six axes (figures 4.7, 4.10, 4.13)."""
    score = _score(cache, job)
    reference = cache.reference(job.scene, job.frames[0])
    found = curves(score, reference, job.option("deg"), job.option("m"), job.option("samples"))
    name = cache.frame(job.scene, job.frames[0]).name or str(job.frames[0])
    return {"label": f"{job.scene}, {name}", "offsets": found.offsets.tolist(), "values": found.values.tolist()}


def _score(cache: WorkerCache, job: EvaluationJob) -> Score:
    features = [cache.features(job.method, job.scene, position)[0] for position in job.frames]
    return cache.methods[job.method].score(features, cache.reference(job.scene, job.frames[0]))


def trust(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """F_C at the reference and at extrinsics that are wrong by each of ERRORS."""
    score, reference = _score(cache, job), cache.reference(job.scene, job.frames[0])
    if not isinstance(score, LevinsonScore):
        raise BadInputError(f"{job.method} has no share of worse neighbours; only levinson has")
    rng = np.random.default_rng(int(job.option("seed")))  # the same for all frames, as if a mount had been displaced
    wrong = []
    for deg, m in ERRORS:
        for _ in range(DIRECTIONS):
            way = rng.normal(size=3)
            way /= np.linalg.norm(way)
            error = se3.exp([*(np.deg2rad(deg) * way), *(m * way)])
            wrong.append([deg, m, worse_share(score, error @ reference)])
    return {"right": worse_share(score, reference), "wrong": wrong}


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


KINDS: dict[str, Callable[[WorkerCache, EvaluationJob], Answer]] = {
    **dict.fromkeys((*OF_TRIALS, *PROTOCOLS), trial),
    MISCALIBRATION: checked,
    "curves": loss_curves,
    "averaging": averaging,
    "similarity": similarities,
    "cost": cost,
    "trust": trust,
}


def run_jobs(setup: Setup, jobs: Sequence[EvaluationJob]) -> list[Answer]:
    """The answers, in order. A method that cannot use its frames gives {"error": reason}; all other errors are raised."""
    cache, answers = worker_cache(setup), []
    for job in jobs:
        try:
            answers.append(KINDS[job.experiment](cache, job))
        except NOT_THE_METHODS:
            raise
        except CalibrationError as error:
            answers.append({"error": str(error)})
    return answers

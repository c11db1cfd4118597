"""Accuracy and cost of a method: one calibration from a wrong start, and CPU time and memory."""

from __future__ import annotations

import contextlib
import time
import tracemalloc
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.errors import CalibrationError
from calib_ros.registration.score.point_score import Score
from calib_ros.registration.search.constraints import SearchBox
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.experiments.job import EvaluationJob
from calib_ros_evaluation.experiments.setup import NOT_THE_METHODS, WorkerCache
from calib_ros_evaluation.methods.method import TracePoint

Matrix = NDArray[np.float64]
KEPT_STEPS = 40  # of a trace
BATCHES, EVALUATIONS = 7, 10  # the middle batch counts; the clock of CPU time is too coarse for one evaluation
LONGEST_S = 0.5  # of a batch: a slow score is evaluated less often
SPREAD = np.repeat([np.deg2rad(0.5), 0.05], 3)  # rad, m; around the reference, where the score is evaluated for its cost


def wrong_start(T: Matrix, job: EvaluationJob) -> Matrix:
    """T_camera_lidar (4, 4) of a trial: off by a left twist, uniform in +- start_deg and +- start_m per axis.

    The direction depends on scene, frames and seed alone: all methods begin at the same place, and at larger sizes farther along
    the same way.
    """
    rng = np.random.default_rng([int(job.option("seed")), zlib.crc32(job.scene.encode()), *job.frames])
    half = np.repeat([np.deg2rad(job.option("start_deg")), job.option("start_m")], 3)
    return se3.exp(rng.uniform(-1, 1, 6) * half) @ T


def trial(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """One calibration from `wrong_start`; see `calibrated`."""
    return calibrated(cache, job, wrong_start(cache.reference(job.scene, job.frames[0]), job))


def calibrated(cache: WorkerCache, job: EvaluationJob, start: Matrix) -> Answer:
    """One calibration from a start (4, 4), searched as far as the job's start_deg and start_m. A method that fails gives an
    answer with the reason; NOT_THE_METHODS is raised."""
    reference = cache.reference(job.scene, job.frames[0])
    answer: Answer = {"status": "done", "reason": "", "start": off(start, reference), "trace": []}
    answer["start_rotation_deg"], answer["start_translation_m"] = _error(start, reference)
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
    if job.option("trace"):
        # A method may see better extrinsics than it ends at: beyond its reach, or one that it does not trust.
        last = found.evaluations, answer["cpu_s"], *_error(found.T, reference)
        answer["trace"] = [list(row) for row in (*_trace(found.trace, reference), last)]
    return answer


def _error(T: Matrix, reference: Matrix) -> tuple[float, float]:
    return se3.rotation_error_deg(reference, T), se3.translation_error_m(reference, T)


def _end(T: Matrix, reference: Matrix) -> Answer:
    deg, m = _error(T, reference)
    return {"end": off(T, reference), "rotation_deg": deg, "translation_m": m}


def off(T: Matrix, reference: Matrix) -> list[float]:
    """Twist (6,) of T against the reference in the camera frame, deg and m."""
    xi = se3.log(T @ se3.inverse(reference))
    return [*np.rad2deg(xi[:3]).tolist(), *xi[3:].tolist()]


def _trace(steps: Sequence[TracePoint], reference: Matrix) -> list[tuple[float, float, float, float]]:
    """Rows of Trial.trace: evaluations, CPU s, deg, m; at most KEPT_STEPS, spread evenly, with the first and the last."""
    if len(steps) > KEPT_STEPS:
        steps = [steps[k] for k in np.unique(np.linspace(0, len(steps) - 1, KEPT_STEPS).round().astype(int))]
    return [(s.evaluations, s.cpu_s, *_error(s.T, reference)) for s in steps]


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


def _memory(cache: WorkerCache, job: EvaluationJob) -> float:
    """Peak of all arrays, MB; numpy reports its own, and those that OpenCV allocates through it."""
    method, T = cache.methods[job.method], cache.reference(job.scene, job.frames[0])
    frames = [cache.frame(job.scene, position) for position in job.frames]
    tracemalloc.start()
    try:
        method.score([method.features(frame) for frame in frames], T).value(T)
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()

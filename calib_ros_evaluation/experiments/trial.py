"""A calibration from a wrong start, and how far from the reference it ends."""

from __future__ import annotations

import contextlib
import time
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.errors import BadInputError, CalibrationError
from calib_ros.registration.constraints import SearchBox
from calib_ros_evaluation.experiments.setup import NOT_THE_METHODS, WorkerCache
from calib_ros_evaluation.methods.levinson import Levinson, worse_share
from calib_ros_evaluation.methods.method import Step
from calib_ros_evaluation.trials.journal import Answer, Job

Matrix = NDArray[np.float64]
KEPT_STEPS = 40  # of a trace


def wrong_start(T: Matrix, job: Job) -> Matrix:
    """T_camera_lidar (4, 4) of a trial: off by a left twist, uniform in +- start_deg and +- start_m per axis.

    The direction depends on scene, frames and seed alone: all methods begin at the same place, and at larger sizes farther along
    the same way.
    """
    rng = np.random.default_rng([int(job.option("seed")), zlib.crc32(job.scene.encode()), *job.frames])
    half = np.repeat([np.deg2rad(job.option("start_deg")), job.option("start_m")], 3)
    return se3.exp(rng.uniform(-1, 1, 6) * half) @ T


def trial(cache: WorkerCache, job: Job) -> Answer:
    """Perform one. What goes wrong with the method is told; NOT_THE_METHODS goes up."""
    reference = cache.reference(job.scene, job.frames[0])
    start = wrong_start(reference, job)
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


def _trace(steps: Sequence[Step], reference: Matrix) -> list[tuple[float, float, float, float]]:
    """Rows of Trial.trace: evaluations, CPU s, deg, m; at most KEPT_STEPS, spread evenly, with the first and the last."""
    if len(steps) > KEPT_STEPS:
        steps = [steps[k] for k in np.unique(np.linspace(0, len(steps) - 1, KEPT_STEPS).round().astype(int))]
    return [(s.evaluations, s.cpu_s, *_error(s.T, reference)) for s in steps]


# Does the share of worse neighbours tell a wrong calibration from the right one? (Levinson and Thrun 2013)
# Errors that are told from none, deg and m: turned about, and shifted along, a direction that the seed draws.
ERRORS = ((0.25, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.05), (0.0, 0.1), (0.0, 0.2))
DIRECTIONS = 8


def trust(cache: WorkerCache, job: Job) -> Answer:
    """F_C at the reference and at extrinsics that are wrong by each of ERRORS."""
    method = cache.methods[job.method]
    if not isinstance(method, Levinson):
        raise BadInputError(f"{job.method} has no share of worse neighbours; only levinson has")
    reference = cache.reference(job.scene, job.frames[0])
    score = method.score([cache.features(job.method, job.scene, position)[0] for position in job.frames], reference)
    step = job.option("step_deg"), job.option("step_m")
    rng = np.random.default_rng(int(job.option("seed")))  # the same for all frames, as if a mount had been knocked
    wrong = []
    for deg, m in ERRORS:
        for _ in range(DIRECTIONS):
            way = rng.normal(size=3)
            way /= np.linalg.norm(way)
            error = se3.exp([*(np.deg2rad(deg) * way), *(m * way)])
            wrong.append([deg, m, worse_share(score, error @ reference, *step)])
    return {"right": worse_share(score, reference, *step), "wrong": wrong}

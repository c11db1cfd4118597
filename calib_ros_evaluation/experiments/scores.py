"""Scores around the reference: along the six axes, over two of them, and against their neighbours."""

from __future__ import annotations

import numpy as np

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.registration.score.point_score import Score
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.curves import curves
from calib_ros_evaluation.experiments.job import EvaluationJob
from calib_ros_evaluation.experiments.setup import WorkerCache
from calib_ros_evaluation.methods.levinson import Levinson, worse_share

# Errors that `trust` compares with none, deg and m: a turn about, and a shift along, a direction that the seed draws.
ERRORS = ((0.25, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.05), (0.0, 0.1), (0.0, 0.2))
DIRECTIONS = 8


def loss_curves(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """Curves over the six axes (figures 4.7, 4.10, 4.13)."""
    score = _score(cache, job)
    reference = cache.reference(job.scene, job.frames[0])
    found = curves(score, reference, job.option("deg"), job.option("m"), job.option("samples"))
    return {"label": label(cache, job), "offsets": found.offsets.tolist(), "values": found.values.tolist()}


def heat_map(cache: WorkerCache, job: EvaluationJob) -> Answer:
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


def label(cache: WorkerCache, job: EvaluationJob) -> str:
    """Name of a job's frames for people."""
    names = [cache.frame(job.scene, position).name or str(position) for position in job.frames]
    return f"{job.scene}, {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"


def _score(cache: WorkerCache, job: EvaluationJob) -> Score:
    features = [cache.features(job.method, job.scene, position)[0] for position in job.frames]
    return cache.methods[job.method].score(features, cache.reference(job.scene, job.frames[0]))


def trust(cache: WorkerCache, job: EvaluationJob) -> Answer:
    """F_C at the reference and at extrinsics that are wrong by each of ERRORS."""
    method = cache.methods[job.method]
    if not isinstance(method, Levinson):
        raise BadInputError(f"{job.method} has no share of worse neighbours; only levinson has")
    reference = cache.reference(job.scene, job.frames[0])
    score = method.score([cache.features(job.method, job.scene, position)[0] for position in job.frames], reference)
    step = job.option("step_deg"), job.option("step_m")
    rng = np.random.default_rng(int(job.option("seed")))  # the same for all frames, as if a mount had been displaced
    wrong = []
    for deg, m in ERRORS:
        for _ in range(DIRECTIONS):
            way = rng.normal(size=3)
            way /= np.linalg.norm(way)
            error = se3.exp([*(np.deg2rad(deg) * way), *(m * way)])
            wrong.append([deg, m, worse_share(score, error @ reference, *step)])
    return {"right": worse_share(score, reference, *step), "wrong": wrong}

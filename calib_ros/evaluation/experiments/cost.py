"""What a method costs: CPU time of features and of one evaluation, and the memory that its arrays take."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.evaluation.experiments.world import World
from calib_ros.evaluation.trials.job import Answer, Job
from calib_ros.registration.scores import Score

Matrix = NDArray[np.float64]
BATCHES, EVALUATIONS = 7, 10  # the middle batch counts; the clock of CPU time is too coarse for one evaluation
LONGEST_S = 0.5  # of a batch: a slow score is evaluated less often
SPREAD = np.repeat([np.deg2rad(0.5), 0.05], 3)  # rad, m; where it is evaluated, around the reference


def cost(world: World, job: Job) -> Answer:
    """Features are made anew for each frame; the first frame does not count, it pays for look-up tables and imports."""
    method, T = world.methods[job.method], world.reference(job.scene, job.frames[0])
    frames = [world.frame(job.scene, position) for position in job.frames]
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
        "memory_mb": _memory(world, job),
    }


def _batch(score: Score, around: list[Matrix]) -> float:
    """CPU s of an evaluation, mean of as many as fit into LONGEST_S."""
    started, spent, done = time.process_time(), 0.0, 0
    while done < len(around) and spent < LONGEST_S:
        score.value(around[done])
        done, spent = done + 1, time.process_time() - started
    return spent / done


def _memory(world: World, job: Job) -> float:
    """Peak of all arrays while one after another is made, MB; numpy reports its own, and those that OpenCV gets from it."""
    method, T = world.methods[job.method], world.reference(job.scene, job.frames[0])
    frames = [world.frame(job.scene, position) for position in job.frames]
    tracemalloc.start()
    try:
        method.score([method.features(frame) for frame in frames], T).value(T)
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()

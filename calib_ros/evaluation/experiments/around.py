"""Scores around the reference: along the six axes, and over two of them."""

from __future__ import annotations

import numpy as np

from calib_ros import se3
from calib_ros.evaluation.curves import curves
from calib_ros.evaluation.experiments.world import World
from calib_ros.evaluation.trials.job import Answer, Job
from calib_ros.registration.scores import Score


def loss_curves(world: World, job: Job) -> Answer:
    """Curves over the six axes (figures 4.7, 4.10, 4.13)."""
    score = _score(world, job)
    reference = world.reference(job.scene, job.frames[0])
    found = curves(score, reference, job.option("deg"), job.option("m"), job.option("samples"))
    return {"label": label(world, job), "offsets": found.offsets.tolist(), "values": found.values.tolist()}


def heat_map(world: World, job: Job) -> Answer:
    """Scores over two axes (figures 3.17, 3.18)."""
    score, reference = _score(world, job), world.reference(job.scene, job.frames[0])
    axes = [int(job.option("first")), int(job.option("second"))]
    unit = np.linspace(-1, 1, job.option("samples"))
    half = np.repeat([np.deg2rad(job.option("deg")), job.option("m")], 3)
    shown = np.repeat([job.option("deg"), 100 * job.option("m")], 3)
    E = np.diag(half)[axes]
    values = [[score.value(se3.exp(x * E[0] + y * E[1]) @ reference) for x in unit] for y in unit]
    offsets = {"x": (unit * shown[axes[0]]).tolist(), "y": (unit * shown[axes[1]]).tolist()}
    return {"label": label(world, job), "values": values, **offsets}


def label(world: World, job: Job) -> str:
    """Name of a job's frames for people."""
    names = [world.frame(job.scene, position).name or str(position) for position in job.frames]
    return f"{job.scene}, {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"


def _score(world: World, job: Job) -> Score:
    features = [world.features(job.method, job.scene, position)[0] for position in job.frames]
    return world.methods[job.method].score(features, world.reference(job.scene, job.frames[0]))

"""Does the share of worse neighbours tell a wrong calibration from the right one? (Levinson and Thrun 2013)"""

from __future__ import annotations

import numpy as np

from calib_ros import se3
from calib_ros.errors import BadInputError
from calib_ros.evaluation.experiments.world import World
from calib_ros.evaluation.methods.levinson import Levinson
from calib_ros.evaluation.methods.levinson_grid import worse_share
from calib_ros.evaluation.trials.job import Answer, Job

# Errors that are told from none, deg and m: turned about, and shifted along, a direction that the seed draws.
ERRORS = ((0.25, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.05), (0.0, 0.1), (0.0, 0.2))
DIRECTIONS = 8


def trust(world: World, job: Job) -> Answer:
    """F_C at the reference and at extrinsics that are wrong by each of ERRORS."""
    method = world.methods[job.method]
    if not isinstance(method, Levinson):
        raise BadInputError(f"{job.method} has no share of worse neighbours; only levinson has")
    reference = world.reference(job.scene, job.frames[0])
    score = method.score([world.features(job.method, job.scene, position)[0] for position in job.frames], reference)
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

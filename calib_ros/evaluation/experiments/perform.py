"""Jobs of an evaluation done, wherever a worker runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from calib_ros.errors import CalibrationError
from calib_ros.evaluation.experiments.around import heat_map, loss_curves
from calib_ros.evaluation.experiments.averaging import averaging
from calib_ros.evaluation.experiments.cost import cost
from calib_ros.evaluation.experiments.setup import Setup
from calib_ros.evaluation.experiments.similar import similarity_of_frames
from calib_ros.evaluation.experiments.trial import trial
from calib_ros.evaluation.experiments.trust import trust
from calib_ros.evaluation.experiments.world import NOT_THE_METHODS, World, world
from calib_ros.evaluation.trials.job import Answer, Job

TRIALS = ("single", "starts", "frames")  # experiments that consist of trials
KINDS: dict[str, Callable[[World, Job], Answer]] = {
    **dict.fromkeys(TRIALS, trial),
    "curves": loss_curves,
    "heat": heat_map,
    "averaging": averaging,
    "similarity": similarity_of_frames,
    "cost": cost,
    "trust": trust,
}


def perform(setup: Setup, jobs: Sequence[Job]) -> list[Answer]:
    """The answers, in order. What a method cannot do with its frames is told in "error"; all else goes up."""
    own, answers = world(setup), []
    for job in jobs:
        try:
            answers.append(KINDS[job.experiment](own, job))
        except NOT_THE_METHODS:
            raise
        except CalibrationError as error:
            answers.append({"error": str(error)})
    return answers

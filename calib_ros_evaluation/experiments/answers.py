"""Runs jobs, wherever a worker is, and reads their answers as results."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.curves import Curves
from calib_ros_evaluation.experiments.job import EvaluationJob
from calib_ros_evaluation.experiments.setup import NOT_THE_METHODS, Setup, WorkerCache, worker_cache
from calib_ros_evaluation.experiments.trial import averaging, checked, cost, loss_curves, similarities, trial, trust
from calib_ros_evaluation.protocols.definitions import MISCALIBRATION, PROTOCOLS
from calib_ros_evaluation.results import (
    SCORES,
    TWIST_AXES,
    Averaging,
    Cost,
    CurveResult,
    Results,
    Similarity,
    Trust,
    trials_table,
)

T = TypeVar("T")
Answers = Mapping[str, Answer]  # by the keys of their jobs
TRIALS = ("single", "starts", "frames")  # experiments that consist of trials
KINDS: dict[str, Callable[[WorkerCache, EvaluationJob], Answer]] = {
    **dict.fromkeys((*TRIALS, *PROTOCOLS), trial),
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


def collect_results(jobs: Sequence[EvaluationJob], answers: Answers, titles: Mapping[str, str]) -> Results:
    """Results of all jobs that have an answer, in their order. titles: method name -> for people.

    BadInputError for an answer that cannot be one of its job.
    """
    found: dict[str, list[Any]] = {name: [] for name, _ in READ.values()}
    failures: list[tuple[str, str]] = []
    for job in jobs:
        answer = answers.get(job.key)
        if answer is None:
            continue
        if "error" in answer:
            what = f"{job.experiment} of {job.method}" if job.method else job.experiment
            failures.append((f"{what}, {job.scene}, frames {' '.join(map(str, job.frames[:10]))}", answer["error"]))
        else:
            name, reader = READ[job.experiment]
            found[name] += read_answers(reader, [job], answers)
    return Results(dict(titles), failures=failures, **found | {"trials": trials_table(found["trials"])})


def read_answers(reader: Callable[[EvaluationJob, Answer], T], jobs: Sequence[EvaluationJob], answers: Answers) -> list[T]:
    """What a reader makes of the answers of all jobs that have one. BadInputError for one that cannot be one of its job."""
    found = []
    for job in jobs:
        try:
            found += [reader(job, answers[job.key])] if job.key in answers else []
        except (KeyError, TypeError, ValueError) as error:
            raise BadInputError(
                f"the answer of {job.key} is damaged ({type(error).__name__}: {error}); remove its line from results.jsonl, or "
                "give --fresh"
            ) from None
    return found


def trial_of(job: EvaluationJob, answer: Answer) -> dict[str, Any]:
    """The row of the table of trials that an answer of `calibrated` tells of."""
    twists = {f"{name}_{axis}": answer[name][k] for name in ("start", "end") for k, axis in enumerate(TWIST_AXES)}
    scores = {name: math.nan if answer[name] is None else float(answer[name]) for name in SCORES}
    known = {"experiment": job.experiment, "method": job.method, "scene": job.scene, "frames": " ".join(map(str, job.frames))}
    return known | dict(job.options) | {name: answer[name] for name in TOLD} | twists | scores


def _averaging(job: EvaluationJob, answer: Answer) -> Averaging:
    names, weights, shares, values = zip(*answer["frames"], strict=True)
    single = tuple(_curves(answer["offsets"], own) for own in values)
    return Averaging(job.method, job.scene, names, np.array(weights), np.array(shares), single, answer["classes_of"])


def _similarity(job: EvaluationJob, answer: Answer) -> Similarity:
    histograms = {int(position): np.array(shares, float) for position, shares in answer["histograms"].items()}
    return Similarity(job.scene, job.frames, np.array(answer["matrix"], float), answer["threshold"], histograms)


def _curves(offsets: Any, values: Any) -> Curves:
    return Curves(np.array(offsets, float), np.array(values, float))


TOLD = (
    *("status", "reason", "rotation_deg", "translation_m", "start_rotation_deg", "start_translation_m"),
    *("evaluations", "cpu_s", "features_cpu_s"),
)
# Experiment -> the field of Results that its results belong to, and what reads an answer.
READ: dict[str, tuple[str, Callable[[EvaluationJob, Answer], Any]]] = {
    **dict.fromkeys(TRIALS, ("trials", trial_of)),
    "curves": ("curves", lambda j, a: CurveResult(j.method, a["label"], _curves(a["offsets"], a["values"]))),
    "averaging": ("averagings", _averaging),
    "similarity": ("similarities", _similarity),
    "cost": ("costs", lambda j, a: Cost(j.method, len(j.frames), *(a[name] for name in Cost._fields[2:]))),
    "trust": ("trusts", lambda j, a: Trust(a["right"], [(deg, m, share) for deg, m, share in a["wrong"]])),
}

"""Runs jobs, wherever a worker is, and reads their answers as results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from calib_ros.errors import BadInputError, CalibrationError
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.curves import Curves
from calib_ros_evaluation.experiments.frames import averaging, similarity_of_frames
from calib_ros_evaluation.experiments.job import Job
from calib_ros_evaluation.experiments.scores import heat_map, loss_curves, trust
from calib_ros_evaluation.experiments.setup import NOT_THE_METHODS, Setup, WorkerCache, worker_cache
from calib_ros_evaluation.experiments.trial import cost, trial
from calib_ros_evaluation.results import Averaging, Cost, CurveResult, HeatMap, Results, Similarity, Trial, Trust

T = TypeVar("T")
TRIALS = ("single", "starts", "frames")  # experiments that consist of trials
KINDS: dict[str, Callable[[WorkerCache, Job], Answer]] = {
    **dict.fromkeys(TRIALS, trial),
    "curves": loss_curves,
    "heat": heat_map,
    "averaging": averaging,
    "similarity": similarity_of_frames,
    "cost": cost,
    "trust": trust,
}


def run_jobs(setup: Setup, jobs: Sequence[Job]) -> list[Answer]:
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


def collect_results(jobs: Sequence[Job], answers: Mapping[str, Answer], titles: Mapping[str, str]) -> Results:
    """Results of all jobs that have an answer, in their order. titles: method name -> for people.

    BadInputError for an answer that cannot be one of its job.
    """
    found: dict[str, list[Any]] = {name: [] for name in ("trials", "curves", "heat", "similarity", "cost", "averaging", "trust")}
    failures: list[tuple[str, str]] = []
    for job in jobs:
        answer = answers.get(job.key)
        if answer is None:
            continue
        one = None if "error" in answer else _read(_READ[job.experiment], job, answer)
        if one is None:
            what = f"{job.experiment} of {job.method}" if job.method else job.experiment
            failures.append((f"{what}, {job.scene}, frames {' '.join(map(str, job.frames[:10]))}", answer["error"]))
        else:
            found["trials" if job.experiment in TRIALS else job.experiment].append(one)
    return Results(
        dict(titles),
        found["trials"],
        found["curves"],
        found["heat"],
        found["similarity"],
        found["cost"],
        found["averaging"],
        tuple(failures),
        found["trust"],
    )


def _read(reader: Callable[[Job, Answer], T], job: Job, answer: Answer) -> T:
    try:
        return reader(job, answer)
    except (KeyError, TypeError, ValueError) as error:
        raise BadInputError(
            f"the answer of {job.key} is damaged ({type(error).__name__}: {error}); remove its line from results.jsonl, or "
            "give --fresh"
        ) from None


def read_trial(job: Job, answer: Answer) -> Trial:
    """The trial that an answer of `calibrated` tells of. BadInputError for one that cannot be."""
    return _read(_trial, job, answer)


def _trial(job: Job, answer: Answer) -> Trial:
    size = {name: job.option(name) for name in ("start_deg", "start_m", "seed")}
    scores = {name: _number(answer[name]) for name in ("score_start", "score_end", "score_reference")}
    twists = {name: tuple(answer[name]) for name in ("start", "end")}
    trace = tuple(map(tuple, answer["trace"]))
    return Trial(job.experiment, job.method, job.scene, job.frames, **size, **(answer | scores | twists | {"trace": trace}))


def _curve(job: Job, answer: Answer) -> CurveResult:
    return CurveResult(job.experiment, job.method, answer["label"], _curves(answer["offsets"], answer["values"]))


def _heat(job: Job, answer: Answer) -> HeatMap:
    axes = (int(job.option("first")), int(job.option("second")))
    x, y, values = (np.array(answer[name], float) for name in ("x", "y", "values"))
    return HeatMap(job.method, answer["label"], axes, x, y, values)


def _similarity(job: Job, answer: Answer) -> Similarity:
    return Similarity(
        job.scene,
        tuple(answer["names"]),
        np.array(answer["stamps"], float),
        np.array(answer["matrix"], float),
        {threshold: tuple(chosen) for threshold, chosen in answer["keyframes"]},
        tuple(answer["online"]),
        answer["online_threshold"],
        {name: np.array(shares, float) for name, shares in answer["histograms"].items()},
    )


def _cost(job: Job, answer: Answer) -> Cost:
    return Cost(
        job.method, job.scene, len(job.frames), answer["features_ms_per_frame"], answer["evaluation_ms"], answer["memory_mb"]
    )


def _averaging(job: Job, answer: Answer) -> Averaging:
    offsets = answer["offsets"]
    return Averaging(
        job.method,
        job.scene,
        tuple(answer["labels"]),
        np.array(answer["weights"], float),
        tuple(_curves(offsets, values) for values in answer["single"]),
        _curves(offsets, answer["weighted"]),
        _curves(offsets, answer["unweighted"]),
        answer["classes"],
        np.array(answer["distances"], float),
    )


def _trust(job: Job, answer: Answer) -> Trust:
    return Trust(job.scene, answer["right"], tuple((deg, m, share) for deg, m, share in answer["wrong"]))


def _curves(offsets: Any, values: Any) -> Curves:
    return Curves(np.array(offsets, float), np.array(values, float))


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


_READ: dict[str, Callable[[Job, Answer], Any]] = {
    **dict.fromkeys(TRIALS, _trial),
    "curves": _curve,
    "heat": _heat,
    "similarity": _similarity,
    "cost": _cost,
    "averaging": _averaging,
    "trust": _trust,
}

"""Trials of a protocol: frames drawn, the extrinsic perturbed, and calibrated as `calib-ros calibrate` does."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from calib_ros.errors import BadInputError
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.experiments.answers import read_answer, trial_of
from calib_ros_evaluation.experiments.job import EvaluationJob, job
from calib_ros_evaluation.experiments.setup import Setup, SourceSummary, worker_cache
from calib_ros_evaluation.experiments.trial import calibrated
from calib_ros_evaluation.methods.own import Own
from calib_ros_evaluation.protocols.definitions import PROTOCOLS, Protocol, Size
from calib_ros_evaluation.results import Trial


def trial_jobs(
    protocol: Protocol, summaries: Sequence[SourceSummary], counts: Sequence[int], trials: int, seed: int
) -> list[EvaluationJob]:
    """All trials: of every source, size of start error and number of frames, as many. Trial k has the seed `seed` + k.

    BadInputError for a source without so many frames of one calibration.
    """
    for one in summaries:
        check_counts(one, counts)
    return [
        job(protocol.name, Own.name, one.label, drawn(one, count, k), {"start_deg": s.deg, "start_m": s.m, "seed": k, "trace": 0})
        for one in summaries
        for s in protocol.sizes
        for count in counts
        for k in range(seed, seed + trials)
    ]


def check_counts(source: SourceSummary, counts: Sequence[int]) -> None:
    """BadInputError for more frames per trial than a source has of one camera and reference."""
    most = max(map(len, source.groups))
    fitting = ",".join(str(count) for count in counts if count <= most) or str(most)
    for count in counts:
        if count > most:
            what = f"only {most} frame{'s' if most > 1 else ''} of one calibration"
            raise BadInputError(
                f"--frames-per-trial {count}: {source.label} has {what}; give --frames-per-trial {fitting}, or another source"
            )


def drawn(source: SourceSummary, count: int, seed: int) -> list[int]:
    """Positions of the frames of a trial, ascending: uniformly of all frames, good or bad, without putting back. Of a source with
    several calibrations, all of the one that the first frame has."""
    rng = np.random.default_rng([seed, zlib.crc32(source.label.encode()), count])
    enough = [group for group in source.groups if len(group) >= count]
    first = rng.choice([position for group in enough for position in group])
    group = next(group for group in enough if first in group)
    others = rng.permutation([position for position in group if position != first])[: count - 1]
    return sorted(int(position) for position in (first, *others))


def run_trials(setup: Setup, jobs: Sequence[EvaluationJob]) -> list[Answer]:
    """The answers, in order. A start has the same direction at every size and number of frames, so that these are compared on
    alike starts; the search region is the size."""
    cache, answers = worker_cache(setup), []
    for one in jobs:
        reference = cache.reference(one.scene, one.frames[0])
        rng = np.random.default_rng([one.option("seed"), zlib.crc32(one.scene.encode())])
        size = Size(one.option("start_deg"), one.option("start_m"))
        answers.append(calibrated(cache, one, PROTOCOLS[one.experiment].start(reference, size, rng)))
    return answers


def collected(jobs: Sequence[EvaluationJob], answers: Mapping[str, Answer]) -> list[Trial]:
    """The trials of all jobs that have an answer. BadInputError for an answer that cannot be one."""
    return [read_answer(trial_of, one, answers[one.key]) for one in jobs if one.key in answers]

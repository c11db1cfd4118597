"""A whole protocol: draw frames and starts, calibrate as `calib-ros calibrate` does where the journal lacks it, write tables and
report."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from calib_ros.errors import BadInputError
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.csv_files import TRIALS as CSV
from calib_ros_evaluation.csv_files import write_trials
from calib_ros_evaluation.evaluate import Progress, RunOptions, answered, silent
from calib_ros_evaluation.experiments.answers import read_answer, trial_of
from calib_ros_evaluation.experiments.job import EvaluationJob, job
from calib_ros_evaluation.experiments.setup import Setup, SourceSummary, WorkerCache, inspect_sources, worker_cache
from calib_ros_evaluation.experiments.trial import calibrated
from calib_ros_evaluation.methods.own import Own
from calib_ros_evaluation.protocols.definitions import COUNTS, MISCALIBRATION, PROTOCOLS, TRIALS, Protocol, Size, check_name
from calib_ros_evaluation.protocols.detection import Perturbed, decisions, detection_jobs, read_table, run_checks
from calib_ros_evaluation.protocols.tables import detection_section, trial_section, write_decisions
from calib_ros_evaluation.report.page import write_sections
from calib_ros_evaluation.report.sections import Section
from calib_ros_evaluation.results import Trial


@dataclass(frozen=True)
class ProtocolOptions(RunOptions):
    """Which protocol. counts: frames per trial. table: of the published perturbations, for MISCALIBRATION."""

    name: str = ""
    counts: tuple[int, ...] = COUNTS
    trials: int = TRIALS
    seed: int = 0
    table: Path | None = None

    def __post_init__(self) -> None:
        check_name(self.name)
        if not self.counts or min(self.counts) < 1:
            raise BadInputError("--frames-per-trial: give whole numbers of at least 1, separated by commas")
        if not 1 <= self.trials <= 100_000:
            raise BadInputError(f"--trials {self.trials}: give 1 to 100000")
        if self.seed < 0:
            raise BadInputError(f"--seed {self.seed}: give 0 or more")
        super().__post_init__()
        if self.name == MISCALIBRATION and self.table is None:
            raise BadInputError(
                f"--protocol {MISCALIBRATION} needs the published perturbations: give their CSV file by --table FILE"
            )
        if self.name != MISCALIBRATION and self.table is not None:
            raise BadInputError(f"--table belongs to --protocol {MISCALIBRATION}; leave it out for {self.name}")


@dataclass(frozen=True)
class Evaluated:
    """What came of it. section: of the report. files: the report first, then the table of trials. notes: for people."""

    section: Section
    files: list[Path]
    notes: list[str]


def evaluate_protocol(options: ProtocolOptions, facts: Mapping[str, str], progress: Progress = silent) -> Evaluated:
    """Do what the journal in the folder does not hold yet, then write tables and report. facts: for the head of the report.

    Interrupted or killed at any moment, the same options go on where it stopped; with more trials or other numbers of frames,
    what is there is kept. Raises BadInputError for a folder that holds something else, for sources that do not fit the protocol,
    and what sources raise that cannot be used.
    """
    rows = read_table(options.table) if options.table is not None else []
    summaries = inspect_sources(options.setup, options.frames, partial(progress, "frames"))
    planned = _jobs(options, summaries, rows)
    work = run_checks if options.name == MISCALIBRATION else run_trials
    answers, damage = answered(options, {"protocol": options.name}, summaries, planned, work, progress)
    section, table = _report(options, planned, answers)
    notes = [*damage, *(text for one in summaries for text in one.notes), *_left_out(rows, planned)]
    facts = {**facts, "Sources": "; ".join(f"{one.label}: {len(one.frames)} frames" for one in summaries)}
    facts |= {"Left out": "; ".join(notes)} if notes else {}
    report = write_sections(options.out, f"Published protocol: {section.heading}", facts, options.settings, [section])
    return Evaluated(section, [*report, table], notes)


def _jobs(options: ProtocolOptions, summaries: list[SourceSummary], rows: list[Perturbed]) -> list[EvaluationJob]:
    if options.name != MISCALIBRATION:
        return trial_jobs(PROTOCOLS[options.name], summaries, options.counts, options.trials, options.seed)
    if len(summaries) != 1:
        raise BadInputError(f"--protocol {MISCALIBRATION} takes one source, the folder of KITTI odometry sequence 00")
    (source,) = summaries
    return detection_jobs(rows, _names(options, source), source, options.counts)


def _names(options: ProtocolOptions, source: SourceSummary) -> dict[str, int]:
    """Of the source's frames, and their positions."""
    cache = WorkerCache(options.setup)
    return {cache.frame(source.label, position).name: position for position in source.frames}


def _left_out(rows: list[Perturbed], planned: list[EvaluationJob]) -> list[str]:
    """What to say of rows that no check is planned for."""
    used = {one.option("row") for one in planned} if rows else set()
    missing = [row for number, row in enumerate(rows) if number not in used]
    if not missing:
        return []
    return [f"{len(missing)} of {len(rows)} rows are of frames that the source does not have, such as {missing[0].frame}"]


def _report(options: ProtocolOptions, planned: list[EvaluationJob], answers: Mapping[str, Answer]) -> tuple[Section, Path]:
    """The report's section, and the file with a row per trial or decision."""
    if options.name == MISCALIBRATION:
        found = decisions(planned, answers)
        return detection_section(found), write_decisions(options.out, found)
    protocol = PROTOCOLS[options.name]
    trials = collected(planned, answers)
    write_trials(options.out / CSV, trials, protocol.succeeded)
    return trial_section(protocol, trials), options.out / CSV


def trial_jobs(
    protocol: Protocol, summaries: Sequence[SourceSummary], counts: Sequence[int], trials: int, seed: int
) -> list[EvaluationJob]:
    """All trials: of every source, size of start error and number of frames, as many. Trial k has the seed `seed` + k.

    BadInputError for a source without so many frames of one calibration.
    """
    for one in summaries:
        check_counts(one, counts)
    return [
        job(protocol.name, Own.name, one.label, drawn(one, count, k), {"start_deg": s.deg, "start_m": s.m, "seed": k})
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

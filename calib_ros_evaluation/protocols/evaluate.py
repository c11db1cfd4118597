"""A whole protocol: plan its trials, do those that the journal lacks, write tables and report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from calib_ros.errors import BadInputError
from calib_ros_check.jobs.journal import Answer
from calib_ros_evaluation.evaluate import Progress, RunOptions, answered, silent
from calib_ros_evaluation.experiments.job import EvaluationJob
from calib_ros_evaluation.experiments.setup import SourceSummary, WorkerCache, inspect_sources
from calib_ros_evaluation.protocols.definitions import COUNTS, MISCALIBRATION, PROTOCOLS, TRIALS, check_name
from calib_ros_evaluation.protocols.detection import Perturbed, decisions, detection_jobs, read_table, run_checks
from calib_ros_evaluation.protocols.tables import detection_section, trial_section, write_decisions, write_protocol_trials
from calib_ros_evaluation.protocols.trials import collected, run_trials, trial_jobs
from calib_ros_evaluation.report.page import write_sections
from calib_ros_evaluation.report.sections import Section


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
    return trial_section(protocol, trials), write_protocol_trials(options.out, protocol, trials)

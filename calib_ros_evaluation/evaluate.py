"""A whole evaluation: plan the jobs, run those that the journal lacks, write tables and report."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import yaml

from calib_ros import __version__
from calib_ros.errors import BadInputError
from calib_ros_check.jobs.journal import Answer, Journal
from calib_ros_check.jobs.pool import run
from calib_ros_evaluation.csv_files import TRIALS, write_trials
from calib_ros_evaluation.experiments.answers import collect_results, run_jobs
from calib_ros_evaluation.experiments.job import EvaluationJob, job
from calib_ros_evaluation.experiments.plan import EXPERIMENTS, FULL, Plan, groups, jobs
from calib_ros_evaluation.experiments.setup import Setup, SourceSummary, WorkerCache, code_fingerprint, inspect_sources
from calib_ros_evaluation.methods.registry import NAMES, check_names
from calib_ros_evaluation.report.page import check_report, write_report
from calib_ros_evaluation.results import Results
from calib_ros_semantics.models.segmentation import SegmentationModels

Progress = Callable[[str, int, int], None]  # called with the stage (frames, trials), done and total


def silent(stage: str, done: int, total: int) -> None:
    """No progress wanted."""


@dataclass(frozen=True)
class RunOptions:
    """What to work on, and with what. frames: of each source, as for --frames. workers: processes on this machine. scheduler:
    address of a Dask cluster instead; empty = none. fresh: forget earlier results."""

    setup: Setup
    out: Path
    frames: str = "all"
    workers: int = 1
    scheduler: str = ""
    fresh: bool = False

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise BadInputError(f"--workers {self.workers}: give at least 1")

    @property
    def settings(self) -> str:
        """The configuration as YAML."""
        return yaml.safe_dump(self.setup.config.to_dict(), sort_keys=False)


@dataclass(frozen=True)
class EvaluationOptions(RunOptions):
    """methods: in the order of the report."""

    plan: Plan = FULL
    methods: tuple[str, ...] = NAMES
    experiments: tuple[str, ...] = EXPERIMENTS

    def __post_init__(self) -> None:
        check_names(self.methods)
        super().__post_init__()


@dataclass(frozen=True)
class Evaluation:
    """What came of it. files: the report first. notes: for people."""

    results: Results
    files: list[Path]
    notes: list[str] = field(default_factory=list)


def evaluate(options: EvaluationOptions, facts: Mapping[str, str], progress: Progress = silent) -> Evaluation:
    """Do what the journal in the folder does not hold yet, then write table and report. facts: for the head of the report.

    Interrupted or killed at any moment, the same options go on where it stopped. Raises BadInputError for a folder that holds
    an evaluation of something else, and what sources raise that cannot be used.
    """
    models = SegmentationModels(options.setup.config.semantics).load()
    summaries = inspect_sources(options.setup, options.frames, partial(progress, "frames"))
    planned = jobs(options.plan, summaries, options.methods, options.experiments)
    answers, damage = answered(options, {}, summaries, planned, run_jobs, progress)
    cache = WorkerCache(options.setup)
    results = collect_results(planned, answers, {name: cache.methods[name].title for name in options.methods})
    notes = [*models, *damage, *(text for one in summaries for text in one.notes)]
    failed = len(results.failures) + sum(trial.status == "failed" for trial in results.trials)
    if failed:
        notes.append(f"{failed} of {len(planned)} jobs failed; the end of the report says why")
    facts = {**facts, **_facts(results, summaries, notes)}
    report = write_report(options.out, results, facts, options.settings)
    if not results.trials:
        (options.out / TRIALS).unlink(missing_ok=True)  # an earlier one
        return Evaluation(results, report, notes)
    write_trials(options.out / TRIALS, results.trials)
    return Evaluation(results, [*report, options.out / TRIALS], notes)


def answered(
    options: RunOptions,
    about: Mapping[str, str],
    summaries: list[SourceSummary],
    planned: Sequence[EvaluationJob],
    work: Callable[[Setup, Sequence[EvaluationJob]], list[Answer]],
    progress: Progress,
) -> tuple[dict[str, Answer], list[str]]:
    """Answers of all planned jobs, by their keys: those that the journal lacks are worked off. And notes on a damaged
    journal. about: what else the journal is about."""
    check_report(options.out)
    about = {"version": __version__, "code": code_fingerprint(), "configuration": options.setup.fingerprint, **about}
    with Journal(options.out, about, options.fresh) as journal:
        same_frames(journal, summaries)
        doing, told = partial(work, options.setup), partial(progress, "trials")
        run(groups(planned), doing, journal, told, options.workers, options.scheduler)
        return dict(journal.done), journal.notes


def same_frames(journal: Journal, summaries: list[SourceSummary]) -> None:
    """Frames of the same name and number must be those that earlier answers are about; where they lie does not matter.
    BadInputError if they are not."""
    for one in summaries:
        for position, content in zip(one.frames, one.content, strict=True):
            mark = job("content", "", one.label, [position])
            earlier = journal.done.get(mark.key)
            if earlier is None:
                journal.add(mark, {"checksum": content})
            elif earlier.get("checksum") != content:
                raise BadInputError(
                    f"{journal.path}: frame {position} of {one.label}, or its reference, is another than when this evaluation "
                    "was begun; choose another --out, or --fresh to begin anew"
                )


def _facts(results: Results, summaries: list[SourceSummary], notes: list[str]) -> dict[str, str]:
    out = {"Sources": "; ".join(f"{one.label}: {len(one.frames)} frames" for one in summaries)}
    if results.trials:
        cpu = sum(trial.cpu_s for trial in results.trials)
        out["Trials"] = f"{len(results.trials)} calibrations, {cpu / 60:.1f} CPU minutes"
    if notes:
        out["Left out"] = "; ".join(notes)
    return out

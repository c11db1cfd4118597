"""A whole evaluation: plan the jobs, run those that the journal lacks, write tables and report."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pandas as pd
import yaml

from calib_ros import __version__
from calib_ros.errors import BadInputError
from calib_ros_check.jobs.pool import Journal, run
from calib_ros_evaluation.experiments.plan import EXPERIMENTS, FULL, Plan, groups, jobs
from calib_ros_evaluation.experiments.setup import Setup, SourceSummary, code_fingerprint, inspect_sources
from calib_ros_evaluation.experiments.trial import run_jobs
from calib_ros_evaluation.methods.own import NAMES, methods
from calib_ros_evaluation.report.page import Section, check_report, sections, write_report
from calib_ros_evaluation.report.tables import summary
from calib_ros_evaluation.results import TRIALS, Answers, EvaluationJob, collect_results, job, write_table
from calib_ros_semantics.models.segmentation import SegmentationModels

Progress = Callable[[str, int, int], None]  # called with the stage (frames, trials), done and total


@dataclass(frozen=True)
class StudyReport:
    """What came of a study. said: lines for the terminal. table: the rows of the file `name`, empty = there is none. notes: for
    people. facts: for the head of the report."""

    title: str
    sections: Sequence[Section]
    said: Sequence[str]
    name: str
    table: pd.DataFrame
    notes: Sequence[str] = ()
    facts: Mapping[str, str] = field(default_factory=dict)


class Study(ABC):
    """What is done with the sources of an evaluation."""

    @property
    def about(self) -> dict[str, str]:
        """What the answers depend on beside sources, configuration and code."""
        return {}

    @abstractmethod
    def jobs(self, setup: Setup, summaries: Sequence[SourceSummary]) -> list[EvaluationJob]:
        """All there is to do, in the order of the report. BadInputError for sources that do not fit the study."""

    @abstractmethod
    def report(self, setup: Setup, planned: Sequence[EvaluationJob], answers: Answers) -> StudyReport:
        """Of all jobs that have an answer. BadInputError for an answer that cannot be one."""


@dataclass(frozen=True)
class Experiments(Study):
    """Those of the thesis and more. methods: in the order of the report."""

    plan: Plan = FULL
    methods: tuple[str, ...] = NAMES
    experiments: tuple[str, ...] = EXPERIMENTS

    def jobs(self, setup: Setup, summaries: Sequence[SourceSummary]) -> list[EvaluationJob]:
        """See Study."""
        return jobs(self.plan, summaries, self.methods, self.experiments)

    def report(self, setup: Setup, planned: Sequence[EvaluationJob], answers: Answers) -> StudyReport:
        """See Study."""
        known = methods(setup.config)
        results = collect_results(planned, answers, {name: known[name].title for name in self.methods})
        trials, whole = results.trials, summary(results)
        failed = len(results.failures) + int((trials.status == "failed").sum())
        notes = [f"{failed} of {len(planned)} jobs failed; the end of the report says why"] if failed else []
        facts = {"Trials": f"{len(trials)} calibrations, {trials.cpu_s.sum() / 60:.1f} CPU minutes"} if len(trials) else {}
        said = [whole.text(), ""] if whole.rows else []
        return StudyReport("Camera-LiDAR calibration: methods compared", sections(results), said, TRIALS, trials, notes, facts)


def evaluate(
    setup: Setup,
    study: Study,
    out: Path,
    facts: Mapping[str, str],
    progress: Progress,
    frames: str = "all",
    workers: int = 1,
    scheduler: str = "",
    fresh: bool = False,
) -> tuple[Sequence[str], list[Path], list[str]]:
    """Do what the journal in the folder `out` does not hold yet, then write table and report. Returns lines for the terminal, the
    files, the report first, and notes for people.

    Interrupted or killed at any moment, the same call goes on where it stopped; with more of the same to do, what is there is
    kept. facts: for the head of the report. frames: of each source, as for --frames. workers: processes on this machine.
    scheduler: address of a Dask cluster instead; empty = none. fresh: forget earlier results. Raises BadInputError for a folder
    that holds an evaluation of something else, and what sources raise that cannot be used.
    """
    models = SegmentationModels(setup.config.semantics).load()
    summaries = inspect_sources(setup, frames, partial(progress, "frames"))
    planned = study.jobs(setup, summaries)
    check_report(out)
    about = {"version": __version__, "code": code_fingerprint(), "configuration": setup.fingerprint, **study.about}
    with Journal(out, about, fresh) as journal:
        same_frames(journal, summaries)
        run(groups(planned), partial(run_jobs, setup), journal, partial(progress, "trials"), workers, scheduler)
        answers, damage = dict(journal.done), journal.notes
    found = study.report(setup, planned, answers)
    notes = [*models, *damage, *(text for one in summaries for text in one.notes), *found.notes]
    facts = {**facts, "Sources": "; ".join(f"{one.label}: {len(one.frames)} frames" for one in summaries), **found.facts}
    facts |= {"Left out": "; ".join(notes)} if notes else {}
    settings = yaml.safe_dump(setup.config.to_dict(), sort_keys=False)
    files = write_report(out, found.title, facts, settings, found.sections)
    if found.table.empty:
        (out / found.name).unlink(missing_ok=True)  # an earlier one
    else:
        write_table(out / found.name, found.table)
        files.append(out / found.name)
    return found.said, files, notes


def same_frames(journal: Journal, summaries: Sequence[SourceSummary]) -> None:
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

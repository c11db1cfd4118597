"""A whole evaluation: jobs planned, done by workers, kept in a journal, gathered and reported."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import yaml

from calib_ros import __version__
from calib_ros.errors import BadInputError
from calib_ros.evaluation.experiments.gather import gathered
from calib_ros.evaluation.experiments.perform import perform
from calib_ros.evaluation.experiments.plan import EXPERIMENTS, FULL, Plan, groups, jobs
from calib_ros.evaluation.experiments.setup import Setup
from calib_ros.evaluation.experiments.survey import Surveyed, survey
from calib_ros.evaluation.experiments.tables import write_tables
from calib_ros.evaluation.experiments.world import World
from calib_ros.evaluation.methods.registry import NAMES, check_names
from calib_ros.evaluation.report.page import write_report
from calib_ros.evaluation.report.pictures import Picture, chosen_cases, overlay_pictures
from calib_ros.evaluation.results import Results
from calib_ros.evaluation.trials.cluster import ClusterPool
from calib_ros.evaluation.trials.journal import Journal
from calib_ros.evaluation.trials.local import LocalPool
from calib_ros.evaluation.trials.runner import Pool, run

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Request:
    """What to evaluate, and with what. frames: of each source, as for --frames. methods: in the order of the report. workers:
    processes on this machine. scheduler: address of a Dask cluster instead; empty = none. fresh: forget earlier results."""

    setup: Setup
    out: Path
    plan: Plan = FULL
    frames: str = "all"
    methods: tuple[str, ...] = NAMES
    experiments: tuple[str, ...] = EXPERIMENTS
    workers: int = 1
    scheduler: str = ""
    fresh: bool = False

    def __post_init__(self) -> None:
        check_names(self.methods)
        if self.workers < 1:
            raise BadInputError(f"--workers {self.workers}: give at least 1")


@dataclass(frozen=True)
class Evaluation:
    """What came of it. files: the report first, then the tables. notes: for people."""

    results: Results
    files: list[Path]
    notes: list[str] = field(default_factory=list)


def evaluate(request: Request, facts: Mapping[str, str], progress: Progress = lambda stage, done, total: None) -> Evaluation:
    """Do what the journal in the folder does not hold yet, then write tables and report. facts: for the head of the report.

    Interrupted or killed at any moment, the same request goes on where it stopped. Raises BadInputError for a folder that holds
    an evaluation of something else, and what sources raise that cannot be used.
    """
    setup = request.setup
    surveyed = survey(setup, request.frames, partial(progress, "frames"))
    planned = jobs(request.plan, surveyed, request.methods, request.experiments)
    with Journal(request.out, _about(setup, surveyed), request.fresh) as journal:
        run(groups(planned), partial(perform, setup), journal, _pool(request), partial(progress, "trials"))
        answers, damage = dict(journal.done), journal.notes
    world = World(setup)
    results = gathered(planned, answers, {name: world.methods[name].title for name in request.methods})
    notes = [*damage, *(text for one in surveyed for text in one.notes)]
    facts = {**facts, **_facts(results, surveyed, notes)}
    settings = yaml.safe_dump(setup.config.to_dict(), sort_keys=False)
    report = write_report(request.out, results, facts, settings, _pictures(world, results))
    return Evaluation(results, [*report, *write_tables(request.out, results)], notes)


def _pool(request: Request) -> Pool:
    return ClusterPool(request.scheduler) if request.scheduler else LocalPool(request.workers)


def _about(setup: Setup, surveyed: list[Surveyed]) -> dict[str, str]:
    """What all results in a folder have in common. Not where the sources lie: a folder may move."""
    scenes = {f"scene {one.label}": one.identity for one in surveyed}
    references = {f"reference of {s.label}": str(s.reference) for s in setup.scenes if s.reference}
    return {"version": __version__, "configuration": setup.fingerprint, **scenes, **references}


def _facts(results: Results, surveyed: list[Surveyed], notes: list[str]) -> dict[str, str]:
    out = {"Sources": "; ".join(f"{one.label}: {len(one.frames)} frames" for one in surveyed)}
    if results.trials:
        cpu = sum(trial.cpu_s for trial in results.trials)
        out["Trials"] = f"{len(results.trials)} calibrations, {cpu / 60:.1f} CPU minutes"
    if notes:
        out["Left out"] = "; ".join(notes)
    return out


def _pictures(world: World, results: Results) -> list[Picture]:
    """Overlays of the best and the worst single frames."""
    cases = []
    for caption, trial in chosen_cases(results.trials, list(results.titles)):
        position = trial.frames[0]
        reference = world.reference(trial.scene, position)
        cases.append((caption, world.frame(trial.scene, position), reference, trial.extrinsic(reference)))
    return overlay_pictures(cases, world.config)

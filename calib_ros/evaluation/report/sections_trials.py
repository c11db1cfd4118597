"""Sections of the report that consist of trials."""

from __future__ import annotations

from collections.abc import Mapping

from calib_ros.evaluation.report import plots_traces, plots_trials, summary, tables
from calib_ros.evaluation.report.plots import Style
from calib_ros.evaluation.report.section import Section
from calib_ros.evaluation.report.selection import in_order, trials_of
from calib_ros.evaluation.report.statistics import axis_errors
from calib_ros.evaluation.results import Results, Trial

Looks = Mapping[str, Style]
SUMMARY = (
    "All methods get the same frames, rectified and with their points moved to the moment of the image, begin at the same wrong "
    "extrinsics, and know how far off these may be. The thesis compares Pandey, Levinson, Castorena, MulFEAT and its own method "
    "(table 4.2). Read the sections below for what stands behind each figure."
)
SINGLE = (
    "Every trial calibrates from one frame and a random wrong start. The boxes are the thesis's figures 4.14 (its own method) "
    "and 4.15 (MulFEAT), the table its table 4.4: errors with their signs, per axis. Signed means can be small where single "
    "errors are large, so look at the second table for how often a trial succeeds and how large its errors are."
)
TRACES = (
    "How fast a method comes near. Each line follows the best extrinsic so far by the method's own score, which knows nothing of "
    "the reference: a line that rises, or ends high, shows a score that is higher at a wrong place. The thesis has no such "
    "figure."
)
STARTS = (
    "How far off the start may be. Trials of one seed lie in the same direction for all methods and sizes; the size is the half "
    "width of a uniform distribution per axis. The thesis does not state its start errors."
)
FRAMES = (
    "What more frames bring: trials from the same sort of start, with one score over so many frames of a scene (section 3.6)."
)
TROUBLES = (
    "Trials that a method refused by itself, or that ended with an error, and why; then other work of the evaluation that failed."
)


def overview(results: Results, looks: Looks) -> Section:
    """One row per method."""
    titles = tuple((name, results.titles.get(name, ""), looks[name].color) for name in looks)
    table = summary.summary(results)
    if not table.rows:
        return Section("summary", "Summary", SUMMARY, methods=titles)
    return Section("summary", "Summary", SUMMARY, tuple(summary.sentences(results)), titles, (table,))


def single(results: Results, looks: Looks) -> Section:
    """Errors of single frames."""
    heading, trials = "Errors of single frames", trials_of(results, "single")
    if not trials:
        return Section("single", heading, SINGLE)
    by_scene = tables.scenes(results)
    made = (tables.axes(results), tables.single(results), *(() if by_scene is None else (by_scene,)))
    ended = {name: own for name, own in trials.items() if len(axis_errors(own))}
    drawn = (plots_trials.boxes("single_boxes", ended, looks),) if ended else ()
    return Section("single", heading, SINGLE, tables=made, plots=drawn)


def traces(results: Results, looks: Looks) -> Section:
    """How fast a method comes near: a plot for each experiment that kept traces."""
    kept: dict[str, dict[str, list[Trial]]] = {}
    for trial in results.trials:
        if trial.trace:
            kept.setdefault(trial.experiment, {}).setdefault(trial.method, []).append(trial)
    drawn = tuple(
        plots_traces.traces(f"traces_{k + 1}", {name: own[name] for name in in_order(results, own)}, looks)
        for k, own in enumerate(kept.values())
    )
    return Section("traces", "Convergence", TRACES, plots=drawn)


def starts(results: Results, looks: Looks) -> Section:
    """Success against the size of the start error."""
    heading, trials = "Size of the start error", trials_of(results, "starts")
    if not trials:
        return Section("starts", heading, STARTS)
    return Section(
        "starts", heading, STARTS, tables=(tables.starts(results),), plots=(plots_trials.starts("starts", trials, looks),)
    )


def frames(results: Results, looks: Looks) -> Section:
    """Errors against the number of frames."""
    heading, trials = "Number of frames", trials_of(results, "frames")
    if not trials:
        return Section("frames", heading, FRAMES)
    return Section(
        "frames", heading, FRAMES, tables=tuple(tables.frames(results)), plots=(plots_trials.frames("frames", trials, looks),)
    )


def troubles(results: Results) -> Section:
    """What was refused or failed."""
    return Section("troubles", "What was refused or failed", TROUBLES, tables=tuple(tables.troubles(results)))

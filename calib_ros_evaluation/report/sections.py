"""The report's sections, in the order of the thesis."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from calib_ros_evaluation.report import plots, summary, tables, trial_plots
from calib_ros_evaluation.report.pictures import Picture
from calib_ros_evaluation.report.plots import LineStyle, Plot, method_styles
from calib_ros_evaluation.report.statistics import (
    all_methods,
    axis_errors,
    curves_of_methods,
    curves_of_scenes,
    in_order,
    mean,
    median,
    trials_of,
)
from calib_ros_evaluation.report.table import Table
from calib_ros_evaluation.results import HeatMap, Results, Trial

Styles = Mapping[str, LineStyle]
MOST_SCENES = 4  # drawn one by one; the tables and the mean have all
# How to read each section.
SUMMARY = (
    "All methods get the same frames, rectified and with their points moved to the moment of the image, begin at the same wrong "
    "extrinsics, and know how far off these may be. The thesis compares Pandey, Levinson, Castorena, MulFEAT and its own method "
    "(table 4.2). The sections below show how each figure comes about."
)
CURVES = (
    "The score of each method along one axis at a time, all others at the reference; each curve is scaled to 0..1, because "
    "scores have different units. A good curve has one peak, at 0, and rises towards it from far away. These are the thesis's "
    "figures 4.7, 4.10 and 4.13, which show three scenes."
)
HEAT = (
    "The score over two axes at once, as in the thesis's figures 3.17 (rotations) and 3.18 (translations): one bright spot on "
    "the cross is what an optimiser needs; ridges are directions that the image constrains little."
)
SINGLE = (
    "Every trial calibrates from one frame and a random wrong start. The boxes are the thesis's figures 4.14 (its own method) "
    "and 4.15 (MulFEAT), the table its table 4.4: errors with their signs, per axis. Signed means can be small where single "
    "errors are large, so look at the second table for how often a trial succeeds and how large its errors are."
)
TRACES = (
    "How fast a method converges. Each line follows the best extrinsic so far by the method's own score, which knows nothing of "
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
AVERAGING = (
    "Three scenes and their averages, as in the thesis's figure 4.16: eq. 3.16 weights each frame's score by its share of main "
    "classes (vehicles, people, poles, signs). A peak nearer 0 is better; the table shows whether weights help."
)
DRIVE = (
    "How alike images of a drive are by their histograms (figure 3.22, eq. 3.15, figure 3.23), and which become keyframes by "
    "algorithm 6: a frame whose similarity to the last keyframe falls below a threshold. Similar frames repeat what is known "
    "already."
)
TRUST = (
    "Levinson and Thrun judge an extrinsic by the share F_C of its 728 neighbours, one step away along any of the axes, that "
    "score less: 1 at the peak of a good score, one half where nothing fits. From how F_C is distributed where the extrinsic is "
    "known to be right, and where it is known to be wrong, follows the probability that it is right. This project's own "
    "monitor is described in docs/online.md."
)
COST = (
    "What the methods cost on one core. The thesis says only that completing feature maps inside the score is slow (section "
    "4.2.1). Time of one evaluation times evaluations is most of an optimisation; features are made once per frame."
)
CASES = (
    "Where LiDAR points and edges fall in the image under the reference and where a trial ended: the best and the worst that "
    "this project's method accepted, and the worst of each baseline. As the thesis's figures 4.6, 4.9 and 4.12, but not only the "
    "good ones."
)
TROUBLES = (
    "Trials that a method refused by itself, or that ended with an error, and why; then other work of the evaluation that failed."
)


@dataclass(frozen=True)
class Section:
    """key: of links, a lower-case word. introduction: how to read it. sentences: what was found, in words. methods: name, title
    and colour of each, where they are explained. What is shown comes in the order of the fields."""

    key: str
    heading: str
    introduction: str
    sentences: tuple[str, ...] = ()
    methods: tuple[tuple[str, str, str], ...] = ()
    tables: tuple[Table, ...] = ()
    plots: tuple[Plot, ...] = ()
    pictures: tuple[Picture, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to show but the introduction."""
        return not (self.sentences or self.tables or self.plots or self.pictures)


def sections(results: Results, pictures: Sequence[Picture]) -> list[Section]:
    """Sections with content; of empty ones those whose experiment failed, with the reason."""
    styles = method_styles(all_methods(results))
    made = [
        overview(results, styles),
        loss_curves(results, styles),
        heat_maps(results),
        single(results, styles),
        traces(results, styles),
        starts(results, styles),
        frames(results, styles),
        averaging(results),
        drive(results),
        _trust(results),
        cost(results, styles),
        Section("cases", "Best and worst cases", CASES, pictures=tuple(pictures)),
        troubles(results),
    ]
    explained = [_with_reason(section, results) if section.is_empty else section for section in made]
    return [section for section in explained if not section.is_empty]


def overview(results: Results, styles: Styles) -> Section:
    """One row per method."""
    titles = tuple((name, results.titles.get(name, ""), styles[name].color) for name in styles)
    table = summary.summary(results)
    if not table.rows:
        return Section("summary", "Summary", SUMMARY, methods=titles)
    return Section("summary", "Summary", SUMMARY, methods=titles, tables=(table,))


def loss_curves(results: Results, styles: Styles) -> Section:
    """Loss curves over six axes."""
    heading, scenes = "Loss curves over six axes", curves_of_scenes(results)
    if not scenes:
        return Section("curves", heading, CURVES)
    caption = "Marks: peaks. Every curve is scaled to 0..1."
    drawn = [
        plots.loss_curves(f"curves_scene_{k}", label, caption, own, styles)
        for k, (label, own) in enumerate(list(scenes.items())[:MOST_SCENES], start=1)
    ]
    if len(scenes) > 1:
        means = {name: plots.mean_curves(own) for name, own in curves_of_methods(results).items()}
        caption = f"Mean of the scaled curves of {len(scenes)} scenes, scaled to 0..1 again. Marks: peaks of the means."
        drawn.append(plots.loss_curves("curves_mean", "Mean of all scenes", caption, means, styles))
    made = (tables.peaks(results), tables.basin(results))
    return Section("curves", heading, CURVES, tables=made, plots=tuple(drawn))


def heat_maps(results: Results) -> Section:
    """Heat maps, a figure for each scene."""
    scenes: dict[str, dict[str, list[HeatMap]]] = {}
    for one in results.heat_maps:
        scenes.setdefault(one.label, {}).setdefault(one.method, []).append(one)
    drawn = tuple(
        plots.heat_maps(f"heat_maps_{k}", label, {name: own[name] for name in in_order(results, own)})
        for k, (label, own) in enumerate(list(scenes.items())[:MOST_SCENES], start=1)
    )
    return Section("heat", "Heat maps", HEAT, plots=drawn)


def single(results: Results, styles: Styles) -> Section:
    """Errors of single frames."""
    heading, trials = "Errors of single frames", trials_of(results, "single")
    if not trials:
        return Section("single", heading, SINGLE)
    by_scene = tables.scenes(results)
    made = (tables.axes(results), tables.single(results), *(() if by_scene is None else (by_scene,)))
    ended = {name: own for name, own in trials.items() if len(axis_errors(own))}
    drawn = (trial_plots.boxes("single_boxes", ended, styles),) if ended else ()
    return Section("single", heading, SINGLE, tables=made, plots=drawn)


def traces(results: Results, styles: Styles) -> Section:
    """How fast a method converges: a plot for each experiment that kept traces."""
    kept: dict[str, dict[str, list[Trial]]] = {}
    for trial in results.trials:
        if trial.trace:
            kept.setdefault(trial.experiment, {}).setdefault(trial.method, []).append(trial)
    drawn = tuple(
        trial_plots.traces(f"traces_{k + 1}", {name: own[name] for name in in_order(results, own)}, styles)
        for k, own in enumerate(kept.values())
    )
    return Section("traces", "Convergence", TRACES, plots=drawn)


def starts(results: Results, styles: Styles) -> Section:
    """Success against the size of the start error."""
    trials = trials_of(results, "starts")
    made = (tables.starts(results),) if trials else ()
    drawn = (trial_plots.starts("starts", trials, styles),) if trials else ()
    return Section("starts", "Size of the start error", STARTS, tables=made, plots=drawn)


def frames(results: Results, styles: Styles) -> Section:
    """Errors against the number of frames."""
    trials = trials_of(results, "frames")
    made = tuple(tables.frames(results)) if trials else ()
    drawn = (trial_plots.frames("frames", trials, styles),) if trials else ()
    return Section("frames", "Number of frames", FRAMES, tables=made, plots=drawn)


def averaging(results: Results) -> Section:
    """Weighted against unweighted averaging."""
    found = results.averagings
    drawn = tuple(plots.averaging(f"averaging_{k}", one) for k, one in enumerate(found, start=1))
    made = tuple(tables.averaging(one) for one in found)
    return Section("averaging", "Weighted averaging", AVERAGING, tables=made, plots=drawn)


def drive(results: Results) -> Section:
    """Similarity of frames, and keyframes."""
    drawn: list[Plot] = []
    for k, one in enumerate(results.similarities, start=1):
        drawn += [plots.histograms(f"histograms_{k}", one)] if one.histograms else []
        drawn += [plots.matrix(f"similarity_{k}", one), plots.keyframes(f"keyframes_{k}", one)]
    made = (tables.keyframes(results.similarities),) if results.similarities else ()
    return Section("similarity", "Histogram similarity and keyframes", DRIVE, tables=made, plots=tuple(drawn))


def _trust(results: Results) -> Section:
    """How well F_C separates right from wrong extrinsics."""
    made = (tables.detection(results.trusts),) if results.trusts else ()
    return Section("trust", "Is a calibration right?", TRUST, tables=made)


def cost(results: Results, styles: Styles) -> Section:
    """CPU time and memory of the methods."""
    if not results.costs:
        return Section("cost", "Cost", COST)
    names = in_order(results, (c.method for c in results.costs))
    own = {name: [c for c in results.costs if c.method == name] for name in names}
    panels = {
        "features, ms per frame": {name: mean(c.features_ms_per_frame for c in found) for name, found in own.items()},
        "one evaluation, ms": {name: mean(c.evaluation_ms for c in found) for name, found in own.items()},
        "memory, MB": {name: mean(c.memory_mb for c in found) for name, found in own.items()},
    }
    whole = {name: median([t.cpu_s + t.features_cpu_s for t in found]) for name, found in trials_of(results, "single").items()}
    panels |= {"whole estimate, CPU s": whole} if whole else {}
    drawn = plots.cost("cost", panels, dict(styles))
    return Section("cost", "Cost", COST, tables=(tables.cost(results),), plots=(drawn,))


def troubles(results: Results) -> Section:
    """What was refused or failed."""
    return Section("troubles", "What was refused or failed", TROUBLES, tables=tuple(tables.troubles(results)))


def _with_reason(section: Section, results: Results) -> Section:
    """What failed begins with the name of its experiment, which is the section's key."""
    reasons = list(dict.fromkeys(why for what, why in results.failures if re.split(r"\W", what, maxsplit=1)[0] == section.key))
    more = f" ({len(reasons) - 1} other reasons are listed at the end)" if len(reasons) > 1 else ""
    return replace(section, sentences=(f"There is nothing to show: {reasons[0]}{more}",) if reasons else ())

"""Sections of the report that show scores, keyframes and cost."""

from __future__ import annotations

from collections.abc import Mapping

from calib_ros.evaluation.report import plots_curves, plots_drive, tables_scores
from calib_ros.evaluation.report.plots import Plot, Style
from calib_ros.evaluation.report.section import Section
from calib_ros.evaluation.report.selection import curves_of_methods, curves_of_scenes, in_order, trials_of
from calib_ros.evaluation.report.statistics import mean, median
from calib_ros.evaluation.results import HeatMap, Results

Looks = Mapping[str, Style]
MOST_SCENES = 4  # drawn one by one; the tables and the mean have all
CURVES = (
    "The score of each method along one axis at a time, all others at the reference; each curve is scaled to 0..1, because "
    "scores have different units. A good curve has one peak, at 0, and rises towards it from far away. These are the thesis's "
    "figures 4.7, 4.10 and 4.13, which show three scenes."
)
HEAT = (
    "The score over two axes at once, as in the thesis's figures 3.17 (rotations) and 3.18 (translations): one bright spot on "
    "the cross is what an optimiser needs; ridges are directions in which the picture tells little."
)
AVERAGING = (
    "Three scenes and their averages, as in the thesis's figure 4.16: eq. 3.16 weights each frame's score by its share of main "
    "classes (vehicles, people, poles, signs). A peak nearer 0 is better; whether weights help is for the table to say."
)
DRIVE = (
    "How alike images of a drive are by their histograms (figure 3.22, eq. 3.15, figure 3.23), and which become keyframes by "
    "algorithm 6: a frame whose similarity to the last keyframe falls below a threshold. Similar frames repeat what is known "
    "already."
)
COST = (
    "What the methods cost on one core. The thesis says only that completing feature maps inside the score is slow (section "
    "4.2.1). Time of one evaluation times evaluations is most of an optimisation; features are made once per frame."
)


def loss_curves(results: Results, looks: Looks) -> Section:
    """Loss curves over six axes."""
    heading, scenes = "Loss curves over six axes", curves_of_scenes(results)
    if not scenes:
        return Section("curves", heading, CURVES)
    caption = "Marks: peaks. Every curve is scaled to 0..1."
    drawn = [
        plots_curves.loss_curves(f"curves_scene_{k}", label, caption, own, looks)
        for k, (label, own) in enumerate(list(scenes.items())[:MOST_SCENES], start=1)
    ]
    if len(scenes) > 1:
        means = {name: plots_curves.mean_curves(own) for name, own in curves_of_methods(results).items()}
        caption = f"Mean of the scaled curves of {len(scenes)} scenes, scaled to 0..1 again. Marks: peaks of the means."
        drawn.append(plots_curves.loss_curves("curves_mean", "Mean of all scenes", caption, means, looks))
    made = (tables_scores.peaks(results), tables_scores.basin(results))
    return Section("curves", heading, CURVES, tables=made, plots=tuple(drawn))


def heat_maps(results: Results) -> Section:
    """Heat maps, a figure for each scene."""
    scenes: dict[str, dict[str, list[HeatMap]]] = {}
    for one in results.heat_maps:
        scenes.setdefault(one.label, {}).setdefault(one.method, []).append(one)
    drawn = tuple(
        plots_curves.heat_maps(f"heat_maps_{k}", label, {name: own[name] for name in in_order(results, own)})
        for k, (label, own) in enumerate(list(scenes.items())[:MOST_SCENES], start=1)
    )
    return Section("heat", "Heat maps", HEAT, plots=drawn)


def averaging(results: Results) -> Section:
    """Weighted against unweighted averaging."""
    found = results.averagings
    drawn = tuple(plots_curves.averaging(f"averaging_{k}", one) for k, one in enumerate(found, start=1))
    made = tuple(tables_scores.averaging(one) for one in found)
    return Section("averaging", "Weighted averaging", AVERAGING, tables=made, plots=drawn)


def drive(results: Results) -> Section:
    """Similarity of frames, and keyframes."""
    drawn: list[Plot] = []
    for k, one in enumerate(results.similarities, start=1):
        drawn += [plots_drive.histograms(f"histograms_{k}", one)] if one.histograms else []
        drawn += [plots_drive.matrix(f"similarity_{k}", one), plots_drive.keyframes(f"keyframes_{k}", one)]
    made = (tables_scores.keyframes(results.similarities),) if results.similarities else ()
    return Section("similarity", "Histogram similarity and keyframes", DRIVE, tables=made, plots=tuple(drawn))


def cost(results: Results, looks: Looks) -> Section:
    """What methods cost."""
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
    drawn = plots_drive.cost("cost", panels, dict(looks))
    return Section("cost", "Cost", COST, tables=(tables_scores.cost(results),), plots=(drawn,))

"""The report's sections, in the order of the thesis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calib_ros_evaluation.report import plots, tables
from calib_ros_evaluation.report.plots import Plot, Styles, method_styles
from calib_ros_evaluation.report.table import Table
from calib_ros_evaluation.report.tables import axis_errors, curves_of_methods, curves_of_scenes, trials_of
from calib_ros_evaluation.results import Results

MOST_SCENES = 4  # drawn one by one; the tables and the mean have all
# How to read each section.
SUMMARY = (
    "All methods get the same frames, rectified and with their points moved to the moment of the image, begin at the same wrong "
    "extrinsics, and know how far off these may be. The thesis compares Pandey, Levinson, Castorena, MulFEAT and its own method "
    "(table 4.2)."
)
CURVES = (
    "The score of each method along one axis at a time, all others at the reference, scaled to 0..1 (figures 4.7, 4.10, 4.13). "
    "A good curve has one peak, at 0, and rises towards it from far away."
)
SINGLE = (
    "Every trial calibrates from one frame and a random wrong start. The boxes are the thesis's figures 4.14 (its own method) "
    "and 4.15 (MulFEAT), the table its table 4.4. Signed means can be small where single errors are large, so look at the second "
    "table for how often a trial succeeds and how large its errors are."
)
STARTS = (
    "How far off the start may be. Trials of one seed lie in the same direction for all methods and sizes; the size is the half "
    "width of a uniform distribution per axis. The thesis does not state its start errors."
)
FRAMES = (
    "What more frames bring: trials from the same sort of start, with one score over so many frames of a scene (section 3.6)."
)
AVERAGING = (
    "Curves of the least, the middle and the most important of the frames, and their averages, as in figure 4.16: eq. 3.16 "
    "weights a frame's score by its share of main classes (vehicles, persons, poles, signs; figures 4.5, 4.8, 4.11)."
)
SIMILARITY = (
    "How alike the images of a drive are by their histograms (eq. 3.15, figures 3.22 and 3.23), and which become keyframes by "
    "algorithm 6: those whose similarity to the last keyframe falls below a threshold."
)
TRUST = (
    "Levinson and Thrun judge an extrinsic by the share F_C of its 728 neighbours, one step away along any of the axes, that "
    "score less: 1 at the peak of a good score, one half where nothing fits."
)
COST = "What the methods cost on one core: evaluations are most of an optimisation; features are made once per frame."
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
    sentences: Sequence[str] = ()
    methods: Sequence[tuple[str, str, str]] = ()
    tables: Sequence[Table] = ()
    plots: Sequence[Plot] = ()


def sections(results: Results) -> list[Section]:
    """Sections with content; the last one says what failed."""
    styles = method_styles(list(results.titles))
    titles = [(name, title, styles[name]["color"]) for name, title in results.titles.items()]
    summary = tables.summary(results)
    made = [
        Section("summary", "Summary", SUMMARY, methods=titles, tables=[summary] if summary.rows else []),
        _loss_curves(results, styles),
    ]
    if one := trials_of(results, "single"):
        found = [tables.axes(results), tables.single(results), *tables.scenes(results)]
        ended = {name: own for name, own in one.items() if len(axis_errors(own))}
        drawn = [plots.boxes(ended, styles)] if ended else []
        made.append(Section("single", "Errors of single frames", SINGLE, tables=found, plots=drawn))
    if starts := trials_of(results, "starts"):
        found, drawn = [tables.starts(results)], [plots.starts(starts, styles)]
        made.append(Section("starts", "Size of the start error", STARTS, tables=found, plots=drawn))
    if frames := trials_of(results, "frames"):
        found, drawn = tables.frames(results), [plots.frames(frames, styles)]
        made.append(Section("frames", "Number of frames", FRAMES, tables=found, plots=drawn))
    averages = [plots.averaging(f"averaging_{k}", own) for k, own in enumerate(results.averagings, start=1)]
    similar = [plots.similarity(f"similarity_{k}", own) for k, own in enumerate(results.similarities, start=1)]
    made += [
        Section("averaging", "Weighted averaging", AVERAGING, tables=tables.averaging(results), plots=averages),
        Section("similarity", "Similarity and keyframes", SIMILARITY, tables=tables.keyframes(results), plots=similar),
        Section("trust", "Is a calibration right?", TRUST, tables=[tables.detection(results.trusts)] if results.trusts else []),
        Section("cost", "Cost", COST, tables=[tables.cost(results)] if results.costs else []),
        Section("troubles", "What was refused or failed", TROUBLES, tables=tables.troubles(results)),
    ]
    return [section for section in made if section.tables or section.plots]


def _loss_curves(results: Results, styles: Styles) -> Section:
    """Loss curves over six axes, of some scenes and their mean."""
    scenes = curves_of_scenes(results)
    caption = "Marks: peaks. Every curve is scaled to 0..1."
    drawn = [
        plots.loss_curves(f"curves_scene_{k}", label, caption, own, styles)
        for k, (label, own) in enumerate(list(scenes.items())[:MOST_SCENES], start=1)
    ]
    if len(scenes) > 1:
        means = {name: plots.mean_curves(own) for name, own in curves_of_methods(results).items()}
        caption = f"Mean of the scaled curves of {len(scenes)} scenes, scaled to 0..1 again. Marks: peaks of the means."
        drawn.append(plots.loss_curves("curves_mean", "Mean of all scenes", caption, means, styles))
    made = [tables.peaks(results), tables.basin(results)] if scenes else []
    return Section("curves", "Loss curves over six axes", CURVES, tables=made, plots=drawn)

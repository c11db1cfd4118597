"""The report of `calib-ros evaluate`, its sections in the order of the thesis: one page that needs no network, its tables as
Markdown, its plots as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from calib_ros.errors import BadInputError
from calib_ros.io import write_atomically
from calib_ros_check.page import page_template
from calib_ros_evaluation.curves import empty_figure
from calib_ros_evaluation.report import plots, tables
from calib_ros_evaluation.report.plots import Plot, Styles, method_styles
from calib_ros_evaluation.report.table import Table, escaped
from calib_ros_evaluation.report.tables import axis_errors, curves_of_methods, curves_of_scenes, trials_of
from calib_ros_evaluation.results import Results

PAGE, TEXT, PLOTS = "report.html", "report.md", "plots"
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

# The parts of the page that differ from that of the steps.
TEMPLATE = """\
{% block style %}
.sheet { background: var(--card); border: 1px solid var(--line); border-radius: 8px; margin: 0 0 1.2rem; min-width: 0; }
.sheet h3, figcaption b { font-size: 1rem; font-weight: 600; }
.sheet h3 { margin: 0; padding: .7rem .9rem 0; }
.sheet p { margin: .5rem .9rem .7rem; font-size: .85rem; color: var(--soft); }
.sheet td, .sheet th { text-align: right; padding: .2rem 0 .2rem 1.4rem; }
.sheet td.text, .sheet th.text { text-align: left; white-space: normal; min-width: 6rem; }
.sheet td:first-child, .sheet th:first-child { padding-left: 0; white-space: nowrap; }
figure .scroll { padding: 0; }
figure .scroll img { max-width: none; margin: 0 auto; background: #ffffff; }
figure.wide .scroll img { min-width: 46rem; }
.findings { margin: 0 0 1.2rem; padding-left: 1.2rem; }
.methods { margin: 0 0 1.2rem; font-size: .93rem; }
.methods dt { color: var(--ink); font-weight: 600; }
.swatch { display: inline-block; width: 1.4rem; height: .35rem; border-radius: 2px; margin-right: .6rem; vertical-align: middle; }
nav ol { font-size: .95rem; columns: 2 16rem; }
nav { display: block; }
{% endblock %}
{% block contents %}
<ol>
{% for section in sections %}
<li><a href="#{{ section.key }}">{{ loop.index }} {{ section.heading }}</a></li>
{% endfor %}
</ol>
{% endblock %}
{% block main %}
{% for section in sections %}
<section>
<h2 id="{{ section.key }}"><span>{{ loop.index }}</span>{{ section.heading }}</h2>
<p class="intro">{{ section.introduction }}</p>
{% if section.sentences %}
<ul class="findings">
{% for sentence in section.sentences %}
<li>{{ sentence }}</li>
{% endfor %}
</ul>
{% endif %}
{% if section.methods %}
<dl class="methods">
{% for name, what, color in section.methods %}
<dt><span class="swatch" style="background:{{ color }}"></span>{{ name }}</dt><dd>{{ what }}</dd>
{% endfor %}
</dl>
{% endif %}
{% for table in section.tables %}
<div class="sheet">
<h3>{{ table.title }}</h3>
<div class="scroll"><table>
<tr>{% for cell in table.header %}<th{% if table.words(loop.index0) %} class="text"{% endif %}>{{ cell }}</th>{% endfor %}</tr>
{% for row in table.rows %}
<tr>{% for cell in row %}<td{% if table.words(loop.index0) %} class="text"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</table></div>
{% for note in table.notes %}
<p>{{ note }}</p>
{% endfor %}
</div>
{% endfor %}
<div class="grid">
{% for plot in section.plots %}
<figure class="wide">
<div class="scroll"><img src="data:image/png;base64,{{ plot.png|base64 }}" width="{{ plot.size[0] }}" height="{{ plot.size[1] }}"
 alt="{{ plot.title }}"></div>
<figcaption><b>{{ plot.title }}</b>{{ plot.caption }}</figcaption>
</figure>
{% endfor %}
</div>
</section>
{% endfor %}
{% endblock %}
"""


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


def check_report(folder: Path) -> None:
    """What write_report would find out too late: MissingDependencyError, or BadInputError for a folder where a file is to be."""
    page_template(TEMPLATE)
    empty_figure(1, 1)
    for path in (folder / PAGE, folder / TEXT):
        if path.is_dir():
            raise BadInputError(f"{path} is a folder, where the report is to be; choose another --out")
    if (folder / PLOTS).exists() and not (folder / PLOTS).is_dir():
        raise BadInputError(f"{folder / PLOTS} is a file, where plots are to be; choose another --out")


def write_report(folder: Path, title: str, facts: Mapping[str, str], configuration: str, made: Sequence[Section]) -> list[Path]:
    """Write report.html, report.md and plots/*.png; returns them, the page first. The same sections give the same bytes.

    facts: the page's head. configuration: as YAML. Nothing is written if anything
    cannot be drawn: MissingDependencyError without Jinja2 or matplotlib, BadInputError if the folder cannot be written.
    """
    template = page_template(TEMPLATE)
    page = template.render(command="evaluate", title=title, facts=facts, configuration=configuration, sections=made)
    text = document(title, facts, made, PLOTS)
    files = {folder / PLOTS / f"{plot.name}.png": plot.png for section in made for plot in section.plots}
    files = {folder / PAGE: page.encode(), **files, folder / TEXT: text.encode()}
    for path, data in files.items():
        write_atomically(path, data)
    return list(files)


def document(title: str, facts: Mapping[str, str], sections: Sequence[Section], folder: str) -> str:
    """All of the report but its pictures. folder: where its plots lie, beside the text."""
    parts = [f"# {escaped(title)}", "\n".join(f"- {escaped(name)}: {escaped(value)}" for name, value in facts.items())]
    for number, section in enumerate(sections, start=1):
        parts += [f"## {number} {escaped(section.heading)}", escaped(section.introduction)]
        listed = [f"- {escaped(sentence)}" for sentence in section.sentences]
        listed += [f"- **{escaped(name)}**: {escaped(what)}" for name, what, _ in section.methods]
        parts += ["\n".join(listed)] if listed else []
        parts += [one.markdown() for one in section.tables]
        parts += [f"![{escaped(plot.title)}]({folder}/{plot.name}.png)\n\n{escaped(plot.caption)}" for plot in section.plots]
    return "\n\n".join(part for part in parts if part) + "\n"

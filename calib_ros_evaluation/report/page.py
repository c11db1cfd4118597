"""The report of `calib-ros evaluate`: one page that needs no network, its tables as Markdown, its plots as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from calib_ros.errors import BadInputError
from calib_ros.io import write_atomically
from calib_ros_check.page import page_template
from calib_ros_evaluation.rendering import empty_figure
from calib_ros_evaluation.report.sections import Section
from calib_ros_evaluation.report.table import escaped

PAGE, TEXT, PLOTS = "report.html", "report.md", "plots"

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

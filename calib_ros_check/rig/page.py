"""The page of a rig's check: sensors, pairs, loops, and a frame of every camera with a LiDAR."""

from __future__ import annotations

from pathlib import Path

from calib_ros.config import Config
from calib_ros.result import VERSION
from calib_ros_check.page import page_template, write_page
from calib_ros_check.report import SHEET, STYLE, picture_of
from calib_ros_check.rig.check import PairCheck, RigCheck, SensorCheck

TEMPLATE = (
    f"{{% block style %}}\n{STYLE}{{% endblock %}}"
    + """
{% block main %}
<p><span class="verdict {{ found.verdict.value }}">{{ found.verdict.value }}</span></p>
<p class="said">{{ found.reason }}</p>
{% for caption, names, rows in tables if rows %}
<h2>{{ caption }}</h2>
<div class="sheet"><div class="scroll"><table>
<tr>{% for name in names %}<th>{{ name }}</th>{% endfor %}</tr>
{% for row in rows %}
<tr>{% for cell in row %}<td class="{{ cell if cell in ('pass', 'fail', 'inconclusive') else 'words' }}">{{ cell }}</td>
{% endfor %}</tr>
{% endfor %}
</table></div></div>
{% endfor %}
{% if found.notes %}
<h2>Notes</h2>
<ul>{% for note in found.notes %}<li>{{ note }}</li>{% endfor %}</ul>
{% endif %}
<h2>Frames</h2>
<p class="intro">Before: as given. After: as the pair's scenes show it. Points are coloured by depth, near ones warm.</p>
"""
    + SHEET
    + "{% endblock %}\n"
)


def write_rig_page(path: str | Path, found: RigCheck, config: Config) -> None:
    """Write the page, atomically. MissingDependencyError without Jinja2, BadInputError if the folder cannot be written."""
    told: list[tuple[str, SensorCheck | PairCheck]] = [*found.sensors.items()]
    told += [(f"{p.target} with {p.source}", p) for p in found.pairs]  # a pair may be there twice
    rows = [
        [name, own.verdict.value, own.judgement.rotation.words, own.judgement.translation.words, own.reason] for name, own in told
    ]
    loops = [
        [", ".join(loop.sensors), "yes" if loop.closes else "no", f"{loop.size[0]:.2f} deg", f"{100 * loop.size[1]:.1f} cm"]
        for loop in found.solution.loops
    ]
    names = ["verdict", "rotation", "translation", ""]
    pictures = [
        (f"{p.target} with {p.source}", picture_of(p.frame, p.check.T_checked, p.check.T_estimated, config))
        for p in found.pairs
        if p.frame is not None and p.check is not None
    ]
    write_page(
        path,
        page_template(TEMPLATE),
        config,
        found.tolerance,
        command="check",
        title=f"Check of {found.source}",
        facts={"recording": found.source, "reference": found.solution.reference, "version": VERSION},
        found=found,
        tables=[
            ("Sensors", ["sensor", *names], rows[: len(found.sensors)]),
            ("Pairs", ["pair", *names], rows[len(found.sensors) :]),
            ("Loops", ["sensors", "closes", "rotation", "translation"], loops),
        ],
        pictures=pictures,
    )

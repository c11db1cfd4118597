"""The page of certificates: which calibrations are doubtful and why, then each one with its error, history and pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from calib_ros.errors import CalibrationError
from calib_ros.io import write_atomically
from calib_ros_check.certify.certificates import Certificate, Certified
from calib_ros_check.fleet.fleet import FleetOptions
from calib_ros_check.fleet.page import PLOT_SIZE, PLOTS, change_size
from calib_ros_check.fleet.page import STYLE as FLEET_STYLE
from calib_ros_check.fleet.plot import plots
from calib_ros_check.fleet.rows import ERROR, VERDICTS
from calib_ros_check.page import page_template
from calib_ros_check.recording import CheckOptions, opened, positions_of, read_frames
from calib_ros_check.report import DEVIATIONS, SHEET, deviation_rows, picture_of
from calib_ros_check.report import STYLE as REPORT_STYLE

MOST_SHOWN, PICTURES = 60, 2  # calibrations with pictures, the doubtful first, and pictures of each; the rest is in the CSV file
MEANINGS = {
    "fail": "wrong: off by more than the tolerance, or mixed up with another one",
    ERROR: "could not be checked",
    "inconclusive": "the frames do not tell",
    "pass": "right to within the tolerance",
}
TEMPLATE = (
    f"{{% block style %}}\n{REPORT_STYLE}{FLEET_STYLE}"
    + """\
.claim { margin: 0 0 .3rem; overflow-wrap: anywhere; } .claim .verdict { font-size: .95rem; }
.error { background: var(--error); }
td.error { background: none; color: var(--error); font-weight: 600; }
{% endblock %}
{% block contents %}{% endblock %}
{% block main %}
<div class="tiles">
{% for verdict, count, meaning in counts %}<div class="tile {{ verdict }}"><b>{{ count }}</b>{{ meaning }}</div>
{% endfor %}
</div>
<h2 id="doubtful">Doubtful calibrations</h2>
{% if doubtful %}
<ul class="changes">
{% for own in doubtful %}
<li class="claim"><b>{{ own.name }}</b>: {{ own.reason }}</li>
{% endfor %}
</ul>
{% else %}<p>None: every calibration is right to within the tolerance.</p>
{% endif %}
<h2 id="all">All calibrations</h2>
<p class="intro">Errors of the calibration as it comes with the data: median, and where it lies with 95 %.</p>
<div class="sheet"><div class="scroll"><table>
<tr><th>calibration</th><th>verdict</th><th>rotation, deg</th><th>translation, cm</th><th>recordings</th><th>frames</th>
<th>changes</th></tr>
{% for own in certificates %}
<tr><td>{{ own.name }}</td><td class="{{ own.verdict }}">{{ own.verdict }}</td>
<td>{{ own.judgement.rotation|size(1, 2) }}</td><td>{{ own.judgement.translation|size(100, 1) }}</td>
<td>{{ own.rows|length }}</td><td>{{ own.frames }}</td><td>{{ own.changes|length or "" }}</td></tr>
{% endfor %}
</table></div></div>
{% for own, rows, figures, pictures in shown %}
<h2>{{ own.name }}</h2>
<p class="claim"><span class="verdict {{ own.verdict }}">{{ own.verdict }}</span></p>
<p class="said">{{ own.reason }}</p>
{% if rows %}
"""
    + DEVIATIONS
    + """\
{% endif %}
{% if own.rows|length > 1 %}
<div class="sheet"><div class="scroll"><table>
<tr><th>recording</th><th>time (UTC)</th><th>verdict</th><th>frames</th><th>in words</th></tr>
{% for row in own.rows %}
<tr><td>{{ row.recording }}</td><td>{{ row.time }}</td><td class="{{ row.verdict }}">{{ row.verdict }}</td>
<td>{{ row.frames }}</td>
<td class="words">{{ row.message }}{{ "; off while its neighbours agree" if row.outlier }}</td></tr>
{% endfor %}
</table></div></div>
{% endif %}
{% for change in own.changes %}
<p>Changed by {{ change|changed }} between {{ change.before.recording }} and {{ change.after.recording }}.</p>
{% endfor %}
{% if own.vehicle.known|length > 1 %}
{% set vehicle = own.vehicle %}
"""
    + PLOTS
    + """\
{% endif %}
{% if pictures %}
<p class="intro">{{ "Before: as it comes with the data. After: as the scenes show it." if own.T_found is not none
else "As it comes with the data." }} Points are coloured by depth, near ones warm.</p>
"""
    + SHEET
    + """\
{% endif %}
{% endfor %}
{% if left_out %}<p>{{ left_out }} more calibrations are in certificates.csv.</p>{% endif %}
{% endblock %}
"""
)


def page_of_certificates() -> Any:
    """The template. MissingDependencyError without Jinja2."""
    return page_template(TEMPLATE, size=_size, changed=change_size)


def write_certificates(path: Path, certified: Certified, options: FleetOptions, facts: Mapping[str, str]) -> None:
    """Write the page, atomically. facts: further ones for its head. Frames that cannot be read here make no pictures."""
    checks, certificates = options.options, certified.certificates
    counted = Counter(own.verdict for own in certificates)
    shown = []
    for own in certificates[:MOST_SHOWN]:
        rows = [] if own.verdict == ERROR else deviation_rows(own.judgement, checks.tolerance)
        figures = plots(own.vehicle, certified.scatter**2) if len(own.vehicle.known) > 1 else []
        shown.append((own, rows, figures, pictures_of(own, checks)))
    page = page_of_certificates().render(
        command="certify",
        title=f"Certificates of {len(certificates)} calibration{'s' if len(certificates) != 1 else ''}",
        facts={"Tolerance": f"{checks.tolerance.deg:g} deg, {100 * checks.tolerance.m:g} cm", **facts},
        configuration=yaml.safe_dump(checks.config.to_dict(), sort_keys=False),
        counts=[(verdict, counted[verdict], MEANINGS[verdict]) for verdict in VERDICTS],
        doubtful=[own for own in certificates if own.verdict != "pass"],
        certificates=certificates,
        shown=shown,
        left_out=len(certificates) - len(shown),
        plot=PLOT_SIZE,
    )
    write_atomically(path, page.encode("utf-8", "backslashreplace"))


def pictures_of(own: Certificate, options: CheckOptions) -> list[tuple[str, bytes]]:
    """Name and JPEG of a few frames."""
    if own.shown is None or own.T_checked is None:
        return []
    options = replace(options, camera=own.shown.camera or options.camera, frames=own.shown.frames or options.frames)
    try:
        source = opened(own.shown.recording.path, options)
        frames = read_frames(source, _few(positions_of(source, options)), options.config, lambda share: None, None)[0]
        return [(frame.name, picture_of(frame, own.T_checked, own.T_found, options.config)) for frame in frames]
    except CalibrationError:
        return []


def _few(positions: Sequence[int]) -> list[int]:
    n = min(PICTURES, len(positions))
    return [positions[int((k + 0.5) * len(positions) / n)] for k in range(n)]


def _size(own: Any, scale: float, digits: int) -> str:
    if own.error != own.error:
        return "-"
    error, low, high = (f"{scale * value:.{digits}f}" for value in (own.error, own.low, own.high))
    return f"{error} ({low} to {high})"

"""The page of a rig: of its check, with the verdict, the size of the error along every axis and other causes, or of its estimate;
with its graph, and frames to look at. That of a pair is the short form, without a graph."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.config import Config
from calib_ros.datasets.source import spread_positions
from calib_ros.errors import CalibrationError
from calib_ros.frame import Frame
from calib_ros.io import check_output
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.overlay import render
from calib_ros.result import VERSION
from calib_ros.rig.description import CAMERA, LIDAR
from calib_ros.rig.edges import RigMeasurer
from calib_ros.rig.report import RigReport
from calib_ros_check.outcome import CheckResult, Deviation, Tolerance
from calib_ros_check.page import page_template, write_page
from calib_ros_check.recording import Checked
from calib_ros_check.rig import shown as html
from calib_ros_check.rig.check import RigCheck
from calib_ros_check.rig.shown import EdgeShown, RigShown, SensorShown
from calib_ros_check.tolerance import TITLES, Judgement, amount, signed

PICTURES = 3
MAX_WIDTH = 1100  # px of a picture on the page
QUALITY = 85  # of JPEG
STYLE = """\
.verdict { display: inline-block; padding: .25rem .9rem; border-radius: 6px; color: #fff; font-weight: 700; font-size: 1.2rem; }
.pass { background: #0072b2; } .fail { background: #a3246e; } .inconclusive { background: #8a5000; }
.said { font-size: 1.05rem; margin: .8rem 0 1.2rem; overflow-wrap: anywhere; white-space: pre-line; }
td.pass, td.fail, td.inconclusive { background: none; font-weight: 600; }
td.pass { color: var(--good); } td.fail { color: var(--bad); } td.inconclusive { color: var(--doubtful); }
td.words { white-space: normal; min-width: 13rem; }
.bar { display: block; width: 15rem; height: 1.5rem; }
.bar .tolerance { fill: var(--good); opacity: .25; } .bar .interval { fill: var(--accent); } .bar .median { fill: var(--ink); }
.bar line { stroke: var(--soft); stroke-width: 1; }
.sheet { background: var(--card); border: 1px solid var(--line); border-radius: 8px; margin: 0 0 1.2rem; min-width: 0; }
.sheet .scroll { padding: .8rem .9rem; }
@media (max-width: 600px) {
  .sheet table { display: block; } .sheet tbody { display: block; } .sheet tr:first-child { display: none; }
  .sheet tr { display: grid; grid-template-columns: 1fr auto; padding: .35rem 0; border-bottom: 1px solid var(--line); }
  .sheet tr:last-child { border: 0; } .sheet td { border: 0; padding: .1rem 0; white-space: normal; min-width: 0; }
  .sheet td:nth-child(even) { text-align: right; } .sheet td.words, .sheet td.wide { grid-column: 1 / -1; text-align: left; }
  .bar { width: 100%; }
}
.part { background: var(--card); border: 1px solid var(--line); border-radius: 8px; margin: 0 0 1.2rem; padding: .7rem .9rem; }
.rig .grid { margin: 0 0 1.2rem; } .rig figure svg { padding: .8rem .6rem .2rem; }
.intro span { white-space: nowrap; }
nav { display: none; }
"""
# Of `rows`, see `deviation_rows`.
DEVIATIONS = """\
<div class="sheet"><div class="scroll"><table>
<tr><th>axis</th><th>verdict</th><th>error</th><th>95 %</th><th></th><th>in words</th></tr>
{% for row in rows %}
<tr><td>{{ row.name }}</td><td class="{{ row.verdict }}">{{ row.verdict }}</td><td>{{ row.error }}</td><td>{{ row.interval }}</td>
<td class="wide">{% if row.bar %}
<svg class="bar" viewBox="-100 0 200 20" preserveAspectRatio="none" role="img" aria-label="{{ row.interval }}">
<rect class="tolerance" x="{{ row.bar.tolerance[0] }}" width="{{ row.bar.tolerance[1] }}" y="0" height="20"/>
<line x1="0" x2="0" y1="0" y2="20"/>
<rect class="interval" x="{{ row.bar.interval[0] }}" width="{{ row.bar.interval[1] }}" y="7" height="6"/>
<rect class="median" x="{{ row.bar.median }}" width="1.5" y="3" height="14"/>
</svg>{% endif %}</td><td class="words">{{ row.words }}</td></tr>
{% endfor %}
</table></div></div>
"""
# Of `pictures`: names and JPEGs.
SHEET = """\
<div class="grid">
{% for name, picture in pictures %}
<figure{{ ' class=wide' if pictures|length < 4 }}><img src="data:image/jpeg;base64,{{ picture|base64 }}" alt="{{ name }}">
<figcaption><b>{{ name }}</b></figcaption></figure>
{% endfor %}
</div>
"""
TEMPLATE = (
    f"{{% block style %}}\n{STYLE}{html.CSS}{{% endblock %}}"
    + """
{% macro judged(rows, causes, mended) %}
<h2>Size of the error</h2>
<p class="intro">The error of the extrinsic{{ " with what was found mended" if mended }}, in the camera's axes:
its median, and where it lies with 95 %. Shaded: the tolerance, {{ facts.tolerance }}.</p>
"""
    + DEVIATIONS
    + """{% if causes %}
<h2>Other causes</h2>
<p class="intro">What else than the mount could be wrong, and was tried.</p>
<div class="sheet"><div class="scroll"><table>
<tr><th>cause</th><th>found</th><th></th></tr>
{% for cause, state, message in causes %}
<tr><td>{{ cause }}</td><td class="{{ 'fail' if state == 'found' else '' }}">{{ state|replace('_', ' ') }}</td>
<td class="words">{{ message }}</td></tr>
{% endfor %}
</table></div></div>
{% endif %}
{% endmacro %}
{% block main %}
{% if verdict %}
<p><span class="verdict {{ verdict }}">{{ verdict }}</span></p>
{% endif %}
<p class="said">{{ said|lines }}</p>
{% if rig %}
<p class="intro">{{ legend|safe }}</p>
<div class="rig">
<div class="grid">{% for drawing, caption in drawings %}<figure>{{ drawing|safe }}<figcaption>{{ caption }}</figcaption></figure>
{% endfor %}</div>
{% for caption, table in tables %}
<div class="part"><h2>{{ caption }}</h2>{{ table|safe }}</div>
{% endfor %}
</div>
{% for name, verdict, rows, causes, mended in parts %}
<details><summary>{{ name }}: {{ verdict }}</summary>{{ judged(rows, causes, mended) }}</details>
{% endfor %}
{% else %}
{{ judged(*parts[0][2:]) }}
{% endif %}
{% if notes %}
<h2>Notes</h2>
<ul>{% for note in notes %}<li>{{ note }}</li>{% endfor %}</ul>
{% endif %}
{% if pictures %}
<h2>Frames</h2>
<p class="intro">{{ compared }} Points are coloured by depth, near ones warm.</p>
"""
    + SHEET
    + "{% endif %}\n{% endblock %}\n"
)
Part = tuple[str, str, list[dict[str, object]], list[tuple[str, str, str]], bool]  # name, verdict, rows, causes, what was mended
SHOWS = "Before: as given. After: as the scenes show it."


def write_report(path: str | Path, checked: Checked) -> None:
    """Write the page of a check to `path`, atomically. MissingDependencyError without Jinja2, BadInputError if the folder cannot
    be written."""
    result, frames, config = checked.result, checked.frames, checked.config
    facts = {
        "extrinsic": f"T_{result.camera_frame}_{result.lidar_frame}",
        "frames": f"{result.frames_used} of {len(result.frame_names)} used",
        "time": f"{result.elapsed_s:.1f} s ({result.cpu_s:.1f} s of CPU)",
        "checked": result.stamp,
        "tolerance": str(result.tolerance),
    }
    shown = [frames[k] for k in spread_positions(PICTURES, len(frames))]
    pictures = [(f"frame {own.name}", picture_of(own, result.T_checked, result.T_estimated, config)) for own in shown]
    part = _part("", result.verdict.value, result, result.tolerance)
    more: dict[str, Any] = {
        "compared": "The extrinsic as given." if result.T_estimated is None else SHOWS,
        "verdict": result.verdict.value,
    }
    _write(path, checked.source, config, facts, pictures, said=result.reason, notes=result.notes, parts=[part], **more)


def write_rig_check(path: str | Path, found: RigCheck, config: Config) -> None:
    """The same of a rig: its sensors, its pairs one by one, and a frame of each camera with a LiDAR."""
    sensors = []
    for name, own in found.sensors.items():
        kind, sizes = CAMERA if name in found.cameras else LIDAR, (own.judgement.rotation, own.judgement.translation)
        error = ", ".join(size.words for size in sizes if size.is_known and size.words not in own.reason)
        verdict = own.verdict.value
        sensors.append(SensorShown(name, kind, found.given[name], verdict, own.reason, usable=None, error=error))
    edges = []
    for p in found.pairs:
        rotation, translation = p.judgement.rotation, p.judgement.translation
        size = (rotation.error, translation.error) if rotation.is_known else None
        edges.append(EdgeShown(p.target, p.source, p.kind, p.verdict.value, html.LEVELS[p.verdict.value], p.reason, size))
    loops = tuple((own.sensors, own.size, own.p_value, own.closes) for own in found.solution.loops)
    rig = RigShown(found.solution.reference, tuple(sensors), tuple(edges), loops, found.reason)
    parts = [_part(f"{p.target} with {p.source}", p.verdict.value, p.check, found.tolerance) for p in found.pairs if p.check]
    pictures = [
        (f"{p.target} with {p.source}", picture_of(p.frame, p.check.T_checked, p.check.T_estimated, config))
        for p in found.pairs
        if p.frame is not None and p.check is not None
    ]
    more: dict[str, Any] = {"verdict": found.verdict.value, "compared": SHOWS, "notes": found.notes, "parts": parts}
    _write(path, found.source, config, {"tolerance": str(found.tolerance)}, pictures, rig, **more)


def write_rig(path: str | Path, report: RigReport, measurer: RigMeasurer) -> None:
    """The page of a result of `calib-ros rig`, with a picture of every camera by the prior and by the solution."""
    known, solution, pictures = measurer.solution([]), report.solution, []
    for camera in report.cameras:
        seen = [m.source for m in report.measured if m.target == camera]
        with suppress(CalibrationError):  # the reason is in the table of edges
            lidar = (seen or measurer.description.lidars)[0]
            source = measurer.rig.pair(camera, lidar)
            ends = known.between(camera, lidar)[0], solution.between(camera, lidar)[0]
            pictures.append((f"{camera} with {lidar}", picture_of(source[len(source) // 2], *ends, measurer.config_of(camera))))
    facts = {"tolerance": f"{report.limits.tolerance_deg:g} deg / {100 * report.limits.tolerance_m:g} cm"}
    more: dict[str, Any] = {"compared": "Before: by the priors. After: as estimated.", "parts": [], "command": "rig", "notes": []}
    _write(path, report.source, measurer.config, facts, pictures, html.of_report(report), **more)


def rig_page(path: str | Path) -> Callable[[RigReport, RigMeasurer], None]:
    """What writes the page of a result to `path`; raises as of `check_report`."""
    check_report(path)
    return partial(write_rig, path)


def _write(
    path: str | Path,
    source: str,
    config: Config,
    facts: Mapping[str, str],
    pictures: Sequence[tuple[str, bytes]],
    rig: RigShown | None = None,
    command: str = "check",
    **shown: Any,
) -> None:
    facts = {"recording": source, **facts, "version": VERSION}
    if rig is not None:
        facts["sensors"] = f"{len(rig.cameras)} cameras, {len(rig.lidars)} LiDARs, in the frame of {rig.reference}"
        captions = "what was measured between the sensors", "the sensors from above, and where each looks"
        shown["drawings"] = list(zip((html.graph_svg(rig), html.plan_svg(rig)), captions, strict=True))
        shown["tables"] = [("Sensors", html.sensors_html(rig)), ("Edges", html.edges_html(rig)), ("Loops", html.loops_html(rig))]
        shown |= {"legend": html.legend(), "said": rig.text}
    name = re.split("[:,]", source.rstrip("/").rpartition("/")[2])[0] or source  # of a synthetic one without its settings
    title = f"{'Rig' if command == 'rig' else 'Check'} of {name}"
    values = {"verdict": "", "command": command, "title": title, "pictures": pictures, "rig": rig, **shown}
    write_page(path, page_template(TEMPLATE), config, facts, **values)


def check_report(path: str | Path) -> None:
    """What `write_report` would find out too late: MissingDependencyError, or BadInputError for a file that cannot be written."""
    page_template(TEMPLATE)
    check_output(path, "--report")


def _part(name: str, verdict: str, check: CheckResult, tolerance: Tolerance) -> Part:
    causes = [(own.cause.words, own.state.value, own.message) for own in check.causes]
    return name, verdict, deviation_rows(check, tolerance), causes, check.cause is not None


def deviation_rows(found: CheckResult | Judgement, tolerance: Tolerance) -> list[dict[str, object]]:
    """What DEVIATIONS shows of the size of an error."""
    return [_row(own, tolerance) for own in (found.rotation, *found.axes[:3], found.translation, *found.axes[3:])]


def _row(own: Deviation, tolerance: Tolerance) -> dict[str, object]:
    is_angle = own.name in ("rotation", "rx", "ry", "rz")
    limit = tolerance.deg if is_angle else tolerance.m
    known, said = own.is_known, amount if own.name in ("rotation", "translation") else signed
    return {
        "name": f"{TITLES[own.name]} ({own.name})" if own.name in TITLES else f"{own.name} in all",
        "verdict": own.verdict.value,
        "error": said(own.error, is_angle) if known else "-",
        "interval": f"{said(own.low, is_angle)} to {said(own.high, is_angle)}" if known else "-",
        "words": own.words,
        "bar": _bar(own, limit) if known else None,
    }


def _bar(own: Deviation, limit: float) -> dict[str, object]:
    """Tolerance and interval on a scale from -100 to 100, whose middle part is linear up to twice the tolerance."""

    def at(value: float) -> float:
        share = value / (2 * limit)
        return float(100 * np.clip(share if abs(share) <= 0.6 else np.sign(share) * (1 - 0.16 / (abs(share) - 0.2)), -1, 1))

    size = own.name in ("rotation", "translation")
    left, low, high = at(0.0 if size else -limit), at(own.low), at(own.high)
    return {
        "tolerance": (round(left, 1), round(at(limit) - left, 1)),
        "interval": (round(low, 1), round(max(high - low, 1.0), 1)),
        "median": round(at(own.error) - 0.75, 1),
    }


def picture_of(frame: Frame, T_checked: Transform, T_found: Transform | None, config: Config) -> bytes:
    """JPEG of a frame under the extrinsic (4, 4) as given and as the scenes show it."""
    shown = deskewed_frame(frame, config.motion)
    error = "" if T_found is None else f"{se3.rotation_error_deg(T_found, T_checked):.2f} deg apart"
    picture = render(
        shown, T_checked if T_found is None else T_found, T_before=T_found if T_found is None else T_checked, lines=[error]
    )
    if picture.shape[1] > MAX_WIDTH:
        height = round(picture.shape[0] * MAX_WIDTH / picture.shape[1])
        picture = np.asarray(cv2.resize(picture, (MAX_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1])

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
from calib_ros.overlay import layout, render
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
MAX_WIDTH = 1200  # px of a picture; on the page fewer, unless one zooms in
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
.beside { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 18rem), 1fr)); gap: 3px; }
.beside > div { position: relative; } .intro span { white-space: nowrap; }
.beside span { position: absolute; padding: 0 .5rem; color: #fff; background: #000a; font-size: .85rem; }
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
# Of `pictures`: names, and what `views_of` gives.
SHEET = """\
<div class="grid">
{% for name, shown in pictures %}
<figure{{ ' class=wide' if pictures|length < 4 }}><div class="beside">{% for what, picture in shown %}
<div><span>{{ what }}</span><img src="data:image/jpeg;base64,{{ picture|base64 }}" alt="{{ name }}, {{ what }}"></div>
{% endfor %}</div><figcaption><b>{{ name }}</b></figcaption></figure>
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
Views = list[tuple[str, bytes]]  # what each shows, and a JPEG
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
    pictures = [(f"frame {own.name}", views_of(own, result.T_checked, result.T_estimated, config)) for own in shown]
    more: dict[str, Any] = {"verdict": result.verdict.value, "said": result.reason, "notes": result.notes}
    more["compared"] = "The extrinsic as given." if result.T_estimated is None else SHOWS
    more["parts"] = [_part("", result.verdict.value, result, result.tolerance)]
    _write(path, checked.source, config, facts, pictures, **more)


def write_rig_check(path: str | Path, found: RigCheck, config: Config) -> None:
    """The same of a rig: its sensors, its pairs one by one, and a frame of each camera with a LiDAR."""
    sensors, edges, parts, pictures = [], [], [], []
    for name, own in found.sensors.items():
        kind, sizes = CAMERA if name in found.cameras else LIDAR, (own.judgement.rotation, own.judgement.translation)
        error = ", ".join(size.words for size in sizes if size.is_known and size.words not in own.reason)
        sensors.append(SensorShown(name, kind, found.given[name], own.verdict.value, own.reason, usable=None, error=error))
    for p in found.pairs:
        name, verdict, turn, shift = f"{p.target} with {p.source}", p.verdict.value, p.judgement.rotation, p.judgement.translation
        size = (turn.error, shift.error) if turn.is_known else None
        edges.append(EdgeShown(p.target, p.source, p.kind, verdict, html.LEVELS[verdict], p.reason, size))
        if p.check is not None:
            parts.append(_part(name, verdict, p.check, found.tolerance))
            if p.frame is not None:
                pictures.append((name, views_of(p.frame, p.check.T_checked, p.check.T_estimated, config)))
    loops = tuple((own.sensors, own.size, own.p_value, own.closes) for own in found.solution.loops)
    rig = RigShown(found.solution.reference, tuple(sensors), tuple(edges), loops, found.reason)
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
            pictures.append((f"{camera} with {lidar}", views_of(source[len(source) // 2], *ends, measurer.config_of(camera))))
    facts = {"tolerance": f"{report.limits.tolerance_deg:g} deg / {100 * report.limits.tolerance_m:g} cm"}
    more: dict[str, Any] = {"compared": "Before: by the priors. After: as estimated.", "parts": [], "notes": []}
    _write(path, report.source, measurer.config, facts, pictures, html.of_report(report), "rig", **more)


def rig_page(path: str | Path) -> Callable[[RigReport, RigMeasurer], None]:
    """What writes the page of a result to `path`; raises as of `check_report`."""
    check_report(path)
    return partial(write_rig, path)


def _write(
    path: str | Path,
    source: str,
    config: Config,
    facts: Mapping[str, str],
    pictures: Sequence[tuple[str, Views]],
    rig: RigShown | None = None,
    command: str = "check",
    **shown: Any,
) -> None:
    facts = {"recording": source, **facts, "version": VERSION}
    if rig is not None:
        facts["sensors"] = f"cameras: {len(rig.cameras)}, LiDARs: {len(rig.lidars)}, in the frame of {rig.reference}"
        captions = "what was measured between the sensors", "the sensors from above, and where each looks"
        shown["drawings"] = list(zip((html.graph_svg(rig), html.plan_svg(rig)), captions, strict=True))
        shown["tables"] = [("Sensors", html.sensors_html(rig)), ("Edges", html.edges_html(rig)), ("Loops", html.loops_html(rig))]
        shown |= {"legend": html.legend(any(own.excess is not None for own in rig.edges)), "said": rig.text}
    # Of a synthetic one that of its rig.
    name = re.sub(r"^synthetic:(.*rig=(\w+).*|.*)$", r"\2", source.rstrip("/").rpartition("/")[2]) or source.partition(":")[0]
    values = {"verdict": "", "command": command, "pictures": pictures, "rig": rig, **shown}
    write_page(path, page_template(TEMPLATE), config, facts, title=f"{command.title()} of {name}", **values)


def check_report(path: str | Path) -> None:
    """What `write_report` would find out too late: MissingDependencyError, or BadInputError for a file that cannot be written."""
    page_template(TEMPLATE)
    check_output(path, "--report")


def _part(name: str, verdict: str, check: CheckResult, tolerance: Tolerance) -> Part:
    causes = [(own.cause.words, own.state.value, own.message) for own in check.causes]
    return name, verdict, deviation_rows(check, tolerance), causes, check.cause is not None


def deviation_rows(found: CheckResult | Judgement, tolerance: Tolerance) -> list[dict[str, object]]:
    """What DEVIATIONS shows of the size of an error."""
    rows: list[dict[str, object]] = []
    for own in (found.rotation, *found.axes[:3], found.translation, *found.axes[3:]):
        is_angle, known = own.name in ("rotation", "rx", "ry", "rz"), own.is_known
        said = amount if own.name in ("rotation", "translation") else signed
        name = f"{TITLES[own.name]} ({own.name})" if own.name in TITLES else f"{own.name} in all"
        error, low, high = (said(value, is_angle) if known else "-" for value in (own.error, own.low, own.high))
        bar = _bar(own, tolerance.deg if is_angle else tolerance.m) if known else None
        row = {"name": name, "verdict": own.verdict.value, "error": error, "words": own.words, "bar": bar}
        rows.append({**row, "interval": f"{low} to {high}" if known else "-"})
    return rows


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


def views_of(frame: Frame, T_checked: Transform, T_found: Transform | None, config: Config) -> Views:
    """A frame with its points at the extrinsic (4, 4) as given, and as the scenes show it."""
    shown, (height, width) = deskewed_frame(frame, config.motion), frame.image.shape[:2]
    names = ["before"] if T_found is None else ["before", f"after, turned by {se3.rotation_error_deg(T_found, T_checked):.2f}°"]
    picture = render(shown, T_checked if T_found is None else T_found, T_before=T_found if T_found is None else T_checked)
    size = min(width, MAX_WIDTH), round(height * min(1.0, MAX_WIDTH / width))
    panels = (picture[y : y + height, x : x + width] for x, y in layout(width, height, len(names)).panels)
    small = (cv2.resize(panel, size, interpolation=cv2.INTER_AREA) for panel in panels)
    jpegs = (cv2.imencode(".jpg", own, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes() for own in small)
    return list(zip(names, jpegs, strict=True))

"""The page of a check: the verdict, the size of the error along every axis, other causes, and frames to look at."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.config import Config
from calib_ros.datasets.positions import spread_positions
from calib_ros.frame import Frame
from calib_ros.io import check_output
from calib_ros.lidar.deskew import deskewed_frame
from calib_ros.overlay import render
from calib_ros_check.outcome import CheckResult, Deviation, Tolerance
from calib_ros_check.page import page_template, write_page
from calib_ros_check.recording import Checked
from calib_ros_check.tolerance import Judgement, amount, signed

PICTURES = 3
MAX_WIDTH = 1100  # px of a picture on the page
QUALITY = 85  # of JPEG
LONG_NAMES = {
    "rx": "pitch (rx)",
    "ry": "yaw (ry)",
    "rz": "roll (rz)",
    "tx": "sideways (tx)",
    "ty": "vertical (ty)",
    "tz": "forward (tz)",
    "rotation": "rotation in all",
    "translation": "translation in all",
}
STYLE = """\
.verdict { display: inline-block; padding: .25rem .9rem; border-radius: 6px; color: #fff; font-weight: 700; font-size: 1.2rem; }
.pass { background: #1d7a3a; } .fail { background: #b3261e; } .inconclusive { background: #8a6d00; }
.said { font-size: 1.05rem; margin: .8rem 0 1.2rem; overflow-wrap: anywhere; }
td.pass, td.fail, td.inconclusive { background: none; font-weight: 600; }
td.pass { color: #1d7a3a; } td.fail { color: #d6453d; } td.inconclusive { color: #a98700; }
td.words { white-space: normal; min-width: 13rem; }
.bar { display: block; width: 15rem; height: 1.5rem; }
.bar .tolerance { fill: #1d7a3a; opacity: .25; } .bar .interval { fill: var(--accent); } .bar .median { fill: var(--ink); }
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
<figure class="wide"><img src="data:image/jpeg;base64,{{ picture|base64 }}" alt="frame {{ name }}">
<figcaption><b>frame {{ name }}</b></figcaption></figure>
{% endfor %}
</div>
"""
TEMPLATE = (
    f"{{% block style %}}\n{STYLE}{{% endblock %}}"
    + """
{% block main %}
<p><span class="verdict {{ result.verdict.value }}">{{ result.verdict.value }}</span></p>
<p class="said">{{ result.reason }}</p>
<h2>Size of the error</h2>
<p class="intro">The error of the extrinsic{{ " with what was found mended" if result.cause else "" }}, in the camera's axes:
its median, and where it lies with 95 %. Green: the tolerance, {{ result.tolerance.deg }} deg and
{{ "%g"|format(100 * result.tolerance.m) }} cm.</p>
"""
    + DEVIATIONS
    + """<h2>Other causes</h2>
<p class="intro">What else than the mount could be wrong, and was tried.</p>
<div class="sheet"><div class="scroll"><table>
<tr><th>cause</th><th>found</th><th></th></tr>
{% for cause, state, message in causes %}
<tr><td>{{ cause }}</td><td class="{{ 'fail' if state == 'found' else '' }}">{{ state|replace('_', ' ') }}</td>
<td class="words">{{ message }}</td></tr>
{% endfor %}
</table></div></div>
{% if result.notes %}
<h2>Notes</h2>
<ul>{% for note in result.notes %}<li>{{ note }}</li>{% endfor %}</ul>
{% endif %}
<h2>Frames</h2>
<p class="intro">{{ "Before: as given. After: as the scenes show it." if both else "The extrinsic as given." }}
Points are coloured by depth, near ones warm.</p>
"""
    + SHEET
    + "{% endblock %}\n"
)


def write_report(path: str | Path, checked: Checked) -> None:
    """Write the page of a check to `path`, atomically. MissingDependencyError without Jinja2, BadInputError if the folder cannot
    be written."""
    result, frames, config = checked.result, checked.frames, checked.config
    facts = {
        "recording": checked.source,
        "extrinsic": f"T_{result.camera_frame}_{result.lidar_frame}",
        "frames": f"{result.frames_used} of {len(result.frame_names)} used",
        "time": f"{result.elapsed_s:.1f} s ({result.cpu_s:.1f} s of CPU)",
        "checked": result.stamp,
    }
    shown = [frames[k] for k in spread_positions(PICTURES, len(frames))]
    pictures = [(frame.name, picture_of(frame, result.T_checked, result.T_estimated, config)) for frame in shown]
    write_page(
        path,
        page_template(TEMPLATE),
        config,
        result.tolerance,
        command="check",
        title=f"Check of {checked.source}",
        facts=facts,
        result=result,
        rows=deviation_rows(result, result.tolerance),
        causes=[(f.cause.words, f.state.value, f.message) for f in result.causes],
        pictures=pictures,
        both=result.T_estimated is not None,
    )


def check_report(path: str | Path) -> None:
    """What `write_report` would find out too late: MissingDependencyError, or BadInputError for a file that cannot be written."""
    page_template(TEMPLATE)
    check_output(path, "--report")


def deviation_rows(found: CheckResult | Judgement, tolerance: Tolerance) -> list[dict[str, object]]:
    """What DEVIATIONS shows of the size of an error."""
    return [_row(own, tolerance) for own in (found.rotation, *found.axes[:3], found.translation, *found.axes[3:])]


def _row(own: Deviation, tolerance: Tolerance) -> dict[str, object]:
    is_angle = own.name in ("rotation", "rx", "ry", "rz")
    limit = tolerance.deg if is_angle else tolerance.m
    known, said = bool(np.isfinite(own.error)), amount if own.name in ("rotation", "translation") else signed
    return {
        "name": LONG_NAMES[own.name],
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

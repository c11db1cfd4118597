"""The page of a fleet: verdicts and changed vehicles first, then all recordings, then each vehicle over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from calib_ros.io import write_atomically
from calib_ros_check.fleet.history import VehicleChange
from calib_ros_check.fleet.plot import HEIGHT, LEFT, RIGHT, TOP, WIDTH, plots
from calib_ros_check.fleet.rows import VERDICTS, Row
from calib_ros_check.page import page_template
from calib_ros_check.tolerance import AXES, amount, signed

if TYPE_CHECKING:
    from calib_ros_check.fleet.fleet import Fleet, FleetOptions

# A browser sorts a few thousand rows at once, and draws some hundred plots; the rest is in the CSV file.
MOST_ROWS, MOST_VEHICLES = 3000, 60
TOLD = 3.0  # standard deviations from which an axis of a change is named
# Colours of verdicts, tiles and plots.
STYLE = """\
:root { --pass: #1d7a3a; --fail: #b3261e; --inconclusive: #8a6d00; --error: #6b4fa0; }
@media (prefers-color-scheme: dark) { :root { --pass: #5cc27c; --fail: #ff8a80; --inconclusive: #e0bd3c; --error: #b9a1ea; } }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(8.5rem, 1fr)); gap: .8rem; margin: 0 0 1.2rem; }
.tile { background: var(--card); border: 1px solid var(--line); border-left-width: 6px; border-radius: 8px; }
.tile { padding: .5rem .9rem; }
.tile b { display: block; font-size: 1.9rem; line-height: 1.2; font-variant-numeric: tabular-nums; }
.tile.pass { border-left-color: var(--pass); } .tile.fail { border-left-color: var(--fail); }
.tile.inconclusive { border-left-color: var(--inconclusive); } .tile.error { border-left-color: var(--error); }
.tile.changed { border-left-color: var(--accent); }
.verdict-pass { color: var(--pass); } .verdict-fail { color: var(--fail); font-weight: 700; }
.verdict-inconclusive { color: var(--inconclusive); } .verdict-error { color: var(--error); font-weight: 700; }
.plots { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 21rem), 1fr)); gap: .3rem; padding: .5rem; }
.plots svg { display: block; width: 100%; height: auto; }
.plots text { font: 11px system-ui, sans-serif; fill: var(--soft); }
.plots .axis { font-weight: 700; fill: var(--ink); }
.plots .grid-line { stroke: var(--line); } .plots .mean { stroke: var(--accent); stroke-width: 1.5; }
.plots .change { stroke: var(--fail); stroke-dasharray: 4 3; stroke-width: 1.5; }
.point { stroke: currentColor; fill: currentColor; } .point.outlier circle { fill: var(--card); stroke-width: 1.5; }
"""
PLOT_SIZE = {"width": WIDTH, "height": HEIGHT, "left": LEFT, "right": WIDTH - RIGHT, "top": TOP}
# Of a `vehicle`, its `figures` and `plot`, PLOT_SIZE.
PLOTS = """\
<div class="plots">
{% for own in figures %}
<svg viewBox="0 0 {{ plot.width }} {{ plot.height }}" role="img" aria-label="{{ own.axis }} of {{ vehicle.name }} over time">
<text class="axis" x="{{ plot.left }}" y="12">{{ own.axis }}, {{ own.unit }}</text>
{% for y, text in own.ticks %}
<line class="grid-line" x1="{{ plot.left }}" x2="{{ plot.right }}" y1="{{ y }}" y2="{{ y }}"/>
<text x="{{ plot.left - 4 }}" y="{{ y + 4 }}" text-anchor="end">{{ text }}</text>
{% endfor %}
{% for x in own.changes %}
<line class="change" x1="{{ x }}" x2="{{ x }}" y1="{{ plot.top }}" y2="{{ plot.height - 18 }}"/>
{% endfor %}
{% for a, b, y in own.means %}<line class="mean" x1="{{ a }}" x2="{{ b }}" y1="{{ y }}" y2="{{ y }}"/>{% endfor %}
{% for p in own.points %}
<g class="point verdict-{{ p.verdict }}{{ ' outlier' if p.outlier }}"><title>{{ p.title }}</title>
<line x1="{{ p.x }}" x2="{{ p.x }}" y1="{{ p.low }}" y2="{{ p.high }}"/><circle cx="{{ p.x }}" cy="{{ p.y }}" r="2.6"/></g>
{% endfor %}
{% if vehicle.known[0].time %}
<text x="{{ plot.left }}" y="{{ plot.height - 4 }}">{{ vehicle.known[0].time[:10] }}</text>
<text x="{{ plot.right }}" y="{{ plot.height - 4 }}" text-anchor="end">{{ vehicle.known[-1].time[:10] }}</text>
{% endif %}
</svg>
{% endfor %}
</div>
"""
TEMPLATE = (
    """\
{% block style %}
"""
    + STYLE
    + """\
.sheet { background: var(--card); border: 1px solid var(--line); border-radius: 8px; margin: 0 0 1.2rem; min-width: 0; }
.sheet .scroll { padding: 0 .9rem .8rem; max-height: 80vh; overflow: auto; }
.sheet th { position: sticky; top: 0; background: var(--card); z-index: 1; padding-top: .6rem; }
td.words { white-space: normal; min-width: 80rem; } td.number { text-align: right; }
#recordings td.name, #recordings th:first-child { position: sticky; left: 0; background: var(--card); }
#recordings th:first-child { z-index: 2; }
#recordings td.name { max-width: 12rem; overflow: hidden; text-overflow: ellipsis; }
th button { all: unset; cursor: pointer; } th button:focus-visible { outline: 2px solid var(--accent); }
th[aria-sort=ascending] button::after { content: " ▲"; } th[aria-sort=descending] button::after { content: " ▼"; }
.more { color: var(--soft); }
@media (max-width: 600px) { #recordings td.name { max-width: 7.5rem; } }
nav { display: none; }
.changes { list-style: none; margin: 0 0 1rem; padding: 0; }
.changes li { background: var(--card); border: 1px solid var(--line); border-left: 6px solid var(--accent); border-radius: 8px; }
.changes li { padding: .5rem .9rem; margin: 0 0 .5rem; overflow-wrap: anywhere; }
.changes span { display: block; color: var(--soft); font-size: .92rem; }
{% endblock %}
{% block contents %}{% endblock %}
{% block main %}
<h2 id="summary">Summary</h2>
<div class="tiles">
{% for verdict, count in counts %}<div class="tile {{ verdict }}"><b>{{ count }}</b>{{ verdict }}</div>
{% endfor %}
<div class="tile changed"><b>{{ changes|map(attribute="vehicle")|unique|list|length }}</b>vehicles changed</div>
</div>
{% if changes %}
<ul class="changes">
{% for change in changes %}
<li><b>{{ change.vehicle }}</b> by {{ change|size }}
<span>between {{ change.before.recording }}, {{ change.before.time|when }}, and {{ change.after.recording }},
{{ change.after.time|when }}
{%- if not change.confirmed %}; not confirmed: only the newest recording shows it{% endif %}</span></li>
{% endfor %}
</ul>
{% else %}<p>No vehicle changed.</p>
{% endif %}
{% if outliers %}
<p>Off, while the recordings before and after agree:
{% for row in outliers %}{{ row.recording }} ({{ row.vehicle }}){{ ", " if not loop.last }}{% endfor %}.</p>
{% endif %}
<h2 id="all">Recordings</h2>
<p class="intro">Errors of the extrinsic, with where they lie with 95 %; drift against the same vehicle's recordings before,
back to its last change. A click on a column's name sorts by it.
{% if left_out %}{{ left_out }} more recordings are in fleet.csv.{% endif %}</p>
<div class="sheet"><div class="scroll"><table id="recordings">
<thead><tr>
{% for name in ["recording", "verdict", "vehicle", "time (UTC)", "cause", "rotation, deg", "translation, cm",
"rx, deg", "ry, deg", "rz, deg", "tx, cm", "ty, cm", "tz, cm", "time offset, ms", "drift", "frames", "CPU, s", "read, MB",
"memory, MB", "message"] %}
<th scope="col"><button type="button">{{ name }}</button></th>
{% endfor %}
</tr></thead><tbody>
{% for one in rows %}
<tr>{% for text, value, kind in one|row %}<td class="{{ kind }}" data-v="{{ value }}"
{%- if kind == "name" %} title="{{ one.path }}"{% endif %}>{{ text }}</td>{% endfor %}</tr>
{% endfor %}
</tbody></table></div></div>
<h2 id="vehicles">Vehicles</h2>
<p class="intro">The extrinsic that each recording shows, against the mean of the first ones, with two standard deviations; in
blue the mean between changes; a dashed line where it changed. Hollow: outliers.
{% if vehicles_left_out %}{{ vehicles_left_out }} more vehicles are in fleet.csv.{% endif %}</p>
{% for vehicle, figures in vehicles %}
<figure class="wide sheet">
<figcaption><b>{{ vehicle.name }}</b>{{ vehicle.rows|length }} recordings, {{ vehicle.known|length }} with an estimate;
{{ vehicle.changes|length or "no" }} change{{ "s" if vehicle.changes|length != 1 }}</figcaption>
{% if figures %}
"""
    + PLOTS
    + """\
{% endif %}
</figure>
{% endfor %}
<h2 id="how">How it was checked</h2>
<dl>
{% for name, value in details.items() %}<dt>{{ name }}</dt><dd>{{ value }}</dd>
{% endfor %}
</dl>
<script>
document.querySelectorAll("#recordings th").forEach((head, column) => head.addEventListener("click", () => {
  const up = head.getAttribute("aria-sort") !== "ascending", body = document.querySelector("#recordings tbody");
  document.querySelectorAll("#recordings th").forEach(other => other.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", up ? "ascending" : "descending");
  const value = row => row.cells[column].dataset.v, rows = [...body.rows];
  const numbers = rows.every(row => value(row) === "" || !isNaN(value(row)));
  rows.sort((a, b) => {
    const x = value(a), y = value(b);
    if (x === "" || y === "") return (x === "") - (y === "");
    const order = numbers ? x - y : x.localeCompare(y);
    return up ? order : -order;
  });
  body.append(...rows);
}));
</script>
{% endblock %}
"""
)


def write_page(path: Path, fleet: Fleet, options: FleetOptions, facts: Mapping[str, str]) -> None:
    """Write the page, atomically. facts: further ones for its head. MissingDependencyError without Jinja2."""
    checks, rows, counts = options.options, fleet.rows, fleet.counts
    shown = sorted(fleet.vehicles, key=lambda own: (not own.changes, not any(row.outlier for row in own.rows), own.name))
    first = sorted(rows, key=lambda row: VERDICTS.index(row.verdict))[:MOST_ROWS]
    count = len({row.vehicle for row in rows if row.verdict != "error"})  # a folder without anything readable is none
    listed = set(map(id, first))
    page = page_of_fleet().render(
        command="check",
        title=f"Check of {len(rows)} recordings of {count} vehicle{'s' if count != 1 else ''}",
        facts={"Tolerance": f"{checks.tolerance.deg:g} deg, {100 * checks.tolerance.m:g} cm", "Extrinsic": checks.extrinsic},
        details={**_details(fleet, options.false_alarms), **facts},
        configuration=yaml.safe_dump(checks.config.to_dict(), sort_keys=False),
        counts=[(verdict, counts[verdict]) for verdict in ("pass", "fail", "inconclusive", "error")],
        changes=fleet.changes,
        outliers=[row for row in rows if row.outlier],
        rows=[row for row in rows if id(row) in listed],
        left_out=len(rows) - len(listed),
        vehicles=[(own, plots(own, fleet.scatter**2)) for own in shown[:MOST_VEHICLES]],
        vehicles_left_out=len(shown[MOST_VEHICLES:]),
        plot=PLOT_SIZE,
    )
    write_atomically(path, page.encode("utf-8", "backslashreplace"))


def page_of_fleet() -> Any:
    """The template. MissingDependencyError without Jinja2."""
    return page_template(TEMPLATE, size=change_size, row=_cells, when=_when)


def _when(time: str) -> str:
    return time.replace("T", " ").rstrip("Z")


def change_size(change: VehicleChange) -> str:
    """How large a change is, and along which axes."""
    scaled = np.r_[np.rad2deg(change.value[:3]), change.value[3:]]
    clear = [k for k in range(6) if abs(scaled[k]) > TOLD * change.sigma[k]]
    axes = [f"{AXES[k]} {signed(scaled[k], k < 3)} ± {amount(change.sigma[k], k < 3)}" for k in clear]
    sizes = f"{amount(change.rotation_deg, True)}, {amount(change.translation_m, False)}"
    return f"{sizes}: {', '.join(axes)}" if axes else sizes


def _details(fleet: Fleet, false_alarms: float) -> dict[str, str]:
    scatter = [f"{value:.2f}" for value in (*np.rad2deg(fleet.scatter[:3]), *(100 * fleet.scatter[3:]))]
    used = [row for row in fleet.rows if row.cpu_s]
    costs = "not measured"
    if used:
        cpu, read, peak = (
            np.array([getattr(row, name) for row in used], float) for name in ("cpu_s", "bytes_read", "peak_bytes")
        )
        costs = (
            f"{cpu.sum() / 60:.1f} min of CPU in all; per recording, median: {np.median(cpu):.1f} s of CPU, "
            f"{np.median(read) / 1e6:.0f} MB read, {np.median(peak) / 1e6:.0f} MB of memory (at most {peak.max() / 1e6:.0f})"
        )
    return {
        "Changes": f"{false_alarms:g} false alarms per recording; recordings scatter by {', '.join(scatter[:3])} deg and "
        f"{', '.join(scatter[3:])} cm (1 sigma) beyond what the checks tell",
        "Cost": costs,
    }


def _cells(row: Row) -> list[tuple[str, object, str]]:
    """Text, value to sort by, and class of the cells of a row."""

    def number(value: float | None, form: str, scale: float = 1.0) -> tuple[str, object, str]:
        return ("-", "", "number") if value is None else (form.format(scale * value), scale * value, "number")

    def interval(name: str, unit: str, scale: float, digits: int) -> tuple[str, object, str]:
        known = [scale * own for end in (unit, "low", "high") if (own := row.errors[f"{name}_{end}"]) is not None]
        if not known:
            return ("-", "", "number")
        error, low, high = known
        return (f"{error:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})", error, "number")

    drift = (
        "-" if row.drift_deg is None else f"{row.drift_deg:.2f} deg, {100 * (row.drift_m or 0):.1f} cm ({row.drift_sigma:.1f} σ)"
    )
    notes = " changed" if row.changed else " outlier" if row.outlier else ""
    return [
        (row.recording, row.recording, "name"),
        (row.verdict, VERDICTS.index(row.verdict), f"verdict-{row.verdict}"),
        (row.vehicle, row.vehicle, ""),
        (_when(row.time), row.time_ns, "number"),
        ((row.cause or "-").replace("_", " "), row.cause or "", ""),
        interval("rotation", "deg", 1.0, 2),
        interval("translation", "m", 100.0, 1),
        *(number(row.errors[f"{axis}_deg"], "{:+.2f}") for axis in AXES[:3]),
        *(number(row.errors[f"{axis}_m"], "{:+.1f}", 100.0) for axis in AXES[3:]),
        number(row.time_offset_s, "{:+.1f}", 1000.0),
        (drift + notes, row.drift_sigma or 0, "number"),
        (str(row.frames), row.frames, "number"),
        number(row.cpu_s, "{:.1f}"),
        number(row.bytes_read, "{:.0f}", 1e-6),
        number(row.peak_bytes, "{:.0f}", 1e-6),
        (row.message, row.message, "words"),
    ]

"""The page of a fleet: what wants attention first, then all recordings or calibrations, then each vehicle over time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros.datasets.source import spread_positions
from calib_ros.errors import CalibrationError
from calib_ros_check.fleet.fleet import Fleet, FleetOptions
from calib_ros_check.fleet.history import ERROR, VERDICTS, Certificate, Row, Vehicle, VehicleChange
from calib_ros_check.page import page_template, write_page
from calib_ros_check.recording import CheckOptions, opened, positions_of, read_frames
from calib_ros_check.report import DEVIATIONS, SHEET, STYLE, Views, deviation_rows, views_of
from calib_ros_check.tolerance import AXES, amount, signed

WIDTH, HEIGHT = 380, 150  # px, where a phone shows it
LEFT, RIGHT, TOP, BOTTOM = 44, 8, 18, 18
SCALES = np.r_[np.rad2deg([1.0] * 3), [100.0] * 3]  # to deg and cm
SMALLEST = (0.1, 1.0)  # half of the range that is shown at least, deg and cm
# A browser sorts a few thousand rows at once, and draws some hundred plots; the rest is in the CSV file.
MOST_ROWS, MOST_VEHICLES = 3000, 60
PICTURES = 2  # of each calibration
TOLD = 3.0  # standard deviations from which an axis of a change is named
PLOT_SIZE = {"width": WIDTH, "height": HEIGHT, "left": LEFT, "right": WIDTH - RIGHT, "top": TOP}
Cell = tuple[str, object, str]  # text, value to sort by, class
TEMPLATE = (
    f"{{% block style %}}\n{STYLE}"
    + """\
:root { --pass: var(--good); --fail: var(--bad); --inconclusive: var(--doubtful); --error: var(--neutral); }
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
.table { background: var(--card); border: 1px solid var(--line); border-radius: 8px; margin: 0 0 1.2rem; min-width: 0; }
.table .scroll { padding: 0 .9rem .8rem; max-height: 80vh; overflow: auto; }
.table th { position: sticky; top: 0; background: var(--card); z-index: 1; padding-top: .6rem; }
.table td.words { min-width: 80rem; } td.number { text-align: right; }
.table td.name, .table th:first-child { position: sticky; left: 0; background: var(--card); }
.table th:first-child { z-index: 2; }
.table td.name { max-width: 18rem; overflow: hidden; text-overflow: ellipsis; }
th button { all: unset; cursor: pointer; } th button:focus-visible { outline: 2px solid var(--accent); }
th[aria-sort=ascending] button::after { content: " ▲"; } th[aria-sort=descending] button::after { content: " ▼"; }
@media (max-width: 600px) { .table td.name { max-width: 7.5rem; } }
h3 { font-size: 1.1rem; margin: 2rem 0 .4rem; overflow-wrap: anywhere; }
.verdict.error { background: var(--error); }
.changes { list-style: none; margin: 0 0 1rem; padding: 0; }
.changes li { background: var(--card); border: 1px solid var(--line); border-left: 6px solid var(--accent); border-radius: 8px; }
.changes li { padding: .5rem .9rem; margin: 0 0 .5rem; overflow-wrap: anywhere; }
.changes span { display: block; color: var(--soft); font-size: .92rem; }
{% endblock %}
{% macro table(rows) %}
<div class="table"><div class="scroll"><table>
<thead><tr>{% for name in rows[0] %}<th scope="col"><button type="button">{{ name }}</button></th>
{% endfor %}</tr></thead><tbody>
{% for cells in rows %}
<tr>{% for text, value, kind in cells.values() %}<td class="{{ kind }}" data-v="{{ value }}"
{%- if kind == "name" %} title="{{ value }}"{% endif %}>{{ text }}</td>{% endfor %}</tr>
{% endfor %}
</tbody></table></div></div>
{% endmacro %}
{% macro listed(entries) %}
<ul class="changes">
{% for name, said, more in entries %}<li><b>{{ name }}</b> {{ said }} <span>{{ more }}</span></li>
{% endfor %}
</ul>
{% endmacro %}
{% block main %}
<h2 id="summary">Summary</h2>
<div class="tiles">
{% for kind, count, meaning in tiles %}<div class="tile {{ kind }}"><b>{{ count }}</b>{{ meaning }}</div>
{% endfor %}
</div>
{% if doubtful %}{{ listed(doubtful) }}{% else %}<p>{{ nothing }}</p>{% endif %}
<h2 id="all">All {{ what }}</h2>
<p class="intro">Errors of the extrinsic: median, and where it lies with 95 %. Drift is against the same vehicle's recordings
before, back to its last change. A click on a column's name sorts by it.
{% if left_out %}{{ left_out }} more {{ what }} are in {{ csv }}.{% endif %}</p>
{{ table(lines) }}
<h2 id="vehicles">{{ caption }}</h2>
<p class="intro">Plots: the extrinsic that each recording shows, against the mean of the first ones, with two standard deviations;
in blue the mean between changes; a dashed line where it changed. Hollow: outliers.
{% if vehicles_left_out %}{{ vehicles_left_out }} more are in {{ csv }}.{% endif %}</p>
{% for vehicle, certificate, figures, rows, changes, recordings, pictures in vehicles %}
<h3>{{ vehicle.name }}</h3>
{% if certificate %}
<p><span class="verdict {{ certificate.verdict }}">{{ certificate.verdict }}</span></p>
<p class="said">{{ certificate.reason|lines }}</p>
{% endif %}
{% if rows %}
"""
    + DEVIATIONS
    + """\
{% endif %}
<p class="intro">{{ vehicle.rows|length }} recordings, {{ vehicle.known|length }} with an estimate;
{{ vehicle.changes|length or "no" }} change{{ "s" if vehicle.changes|length != 1 }}</p>
{% if recordings %}{{ listed(changes) }}{{ table(recordings) }}{% endif %}
{% if figures %}
<figure class="wide"><div class="plots">
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
<g class="point verdict-{{ p.row.verdict }}{{ ' outlier' if p.row.outlier }}"><title>{{ p.title }}</title>
<line x1="{{ p.x }}" x2="{{ p.x }}" y1="{{ p.low }}" y2="{{ p.high }}"/><circle cx="{{ p.x }}" cy="{{ p.y }}" r="2.6"/></g>
{% endfor %}
{% if vehicle.known[0].time %}
<text x="{{ plot.left }}" y="{{ plot.height - 4 }}">{{ vehicle.known[0].time[:10] }}</text>
<text x="{{ plot.right }}" y="{{ plot.height - 4 }}" text-anchor="end">{{ vehicle.known[-1].time[:10] }}</text>
{% endif %}
</svg>
{% endfor %}
</div></figure>
{% endif %}
{% if pictures %}
<p class="intro">{{ "Before: as it comes with the data. After: as the scenes show it." if certificate.T_found is not none
else "As it comes with the data." }} Points are coloured by depth, near ones warm.</p>
"""
    + SHEET
    + """\
{% endif %}
{% endfor %}
<h2 id="how">How it was checked</h2>
<dl>
{% for name, value in details.items() %}<dt>{{ name }}</dt><dd>{{ value }}</dd>
{% endfor %}
</dl>
<script>
document.querySelectorAll(".table table").forEach(table => table.querySelectorAll("th").forEach((head, column) =>
head.addEventListener("click", () => {
  const up = head.getAttribute("aria-sort") !== "ascending", body = table.querySelector("tbody");
  table.querySelectorAll("th").forEach(other => other.removeAttribute("aria-sort"));
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
})));
</script>
{% endblock %}
"""
)


def plots(vehicle: Vehicle, variances: Matrix) -> list[dict[str, Any]]:
    """Six plots, one per axis, against the mean of the first segment; none without an estimate. variances: (6,) between
    recordings.

    Of each, px: points, with two standard deviations to either side (low, high), cut off at the edges; means: (x from, x to, y)
    of the segments; changes: x of each; ticks: (y, text).
    """
    if not vehicle.known:
        return []
    own, found = vehicle.sequence.with_scatter(variances), vehicle.segments
    # By time, or in even steps where the times tell no two apart.
    times = np.array([row.time_ns for row in vehicle.known], float)
    known = np.ptp(times) > 0 and (times > 0).all()
    share = (times - times.min()) / np.ptp(times) if known else np.arange(len(times)) / max(len(times) - 1, 1)
    x = np.round(LEFT + 8 + (WIDTH - LEFT - RIGHT - 16) * share, 1).tolist()
    values = (own.values - found.means[0]) * SCALES
    bars = 2 * np.sqrt(np.diagonal(own.covariances, axis1=1, axis2=2)) * SCALES
    means = (found.means - found.means[0]) * SCALES
    inside = np.array([k not in found.outliers for k in range(len(values))])
    spans = [np.flatnonzero(found.labels == label) for label in range(len(means))]
    divisions = [(x[span[0]] + x[before[-1]]) / 2 for before, span in pairwise(spans)]
    out = []
    for axis, name in enumerate(AXES):
        unit = "deg" if axis < 3 else "cm"
        # A recording that tells little must not flatten all others.
        reach = np.abs(values[inside, axis]) + np.minimum(bars[inside, axis], 2 * np.median(bars[inside, axis]))
        half = max(float(np.quantile(reach, 0.95)), float(np.abs(means[:, axis]).max()) * 1.2, SMALLEST[axis // 3]) * 1.1

        def at(value: float, half: float = half) -> float:  # px from the top, cut off at the edges
            return round(float(np.interp(value, (-half, half), (HEIGHT - BOTTOM, TOP))), 1)

        points = [
            {
                **{"x": x[k], "y": at(value), "low": at(value - bar), "high": at(value + bar), "row": row},
                "title": f"{row.recording}, {row.time}: {value:+.2f} +- {bar:.2f} {unit}",
            }
            for k, (row, value, bar) in enumerate(zip(vehicle.known, values[:, axis], bars[:, axis], strict=True))
        ]
        lines = [(x[span[0]] - 4, x[span[-1]] + 4, at(mean)) for mean, span in zip(means[:, axis], spans, strict=True)]
        power = 10.0 ** np.floor(np.log10(half / 1.5))
        tick = float(max(step for step in (1, 2, 5) if step * power <= half / 1.5 * (1 + 1e-9)) * power)
        ticks = [(at(value), f"{value:+g}" if value else "0") for value in (-tick, 0.0, tick)]
        out.append({"axis": name, "unit": unit, "points": points, "means": lines, "changes": divisions, "ticks": ticks})
    return out


def write_fleet_page(path: Path, fleet: Fleet, options: FleetOptions, facts: Mapping[str, str]) -> None:
    """Write the page, atomically. facts: further ones for its end. Frames that cannot be read here make no pictures."""
    checks, rows, certificates = options.options, fleet.rows, fleet.certificates
    tiles = [(verdict, count, verdict) for verdict, count in fleet.counts.items()]
    if certificates:
        what, title, caption = "calibrations", f"Certificates of {_many(len(certificates), 'calibration')}", "Calibrations"
        lines = [_certificate_cells(own) for own in certificates]
        doubtful = [(f"{own.vehicle.name}:", own.reason, "") for own in certificates if own.verdict != "pass"]
        sections = [_certified(own, fleet, checks) for own in certificates[:MOST_VEHICLES]]
    else:
        count = len({row.vehicle for row in rows if row.verdict != ERROR})  # a folder without anything readable is none
        what, caption = "recordings", "Vehicles"
        title = f"Check of {_many(len(rows), 'recording')} of {_many(count, 'vehicle')}"
        tiles.append(("changed", len({change.vehicle for change in fleet.changes}), "vehicles changed"))
        first = {id(row) for row in sorted(rows, key=lambda row: VERDICTS.index(row.verdict))[:MOST_ROWS]}
        lines = [_cells(row) for row in rows if id(row) in first]
        off = "is off, while the recordings before and after agree"
        doubtful = [*map(_told, fleet.changes), *((f"{row.recording} ({row.vehicle})", off, "") for row in rows if row.outlier)]
        shown = sorted(fleet.vehicles, key=lambda own: (not own.changes, not any(row.outlier for row in own.rows), own.name))
        sections = [(own, None, plots(own, fleet.variances), [], [], [], []) for own in shown[:MOST_VEHICLES]]
    write_page(
        path,
        page_template(TEMPLATE),
        checks.config,
        {"tolerance": str(checks.tolerance), "extrinsic": checks.extrinsic},
        command="certify" if certificates else "check",
        title=title,
        details={**_details(fleet, options.false_alarms), **facts},
        what=what,
        caption=caption,
        csv=path.with_suffix(".csv").name,
        tiles=tiles,
        doubtful=doubtful,
        nothing="None is doubtful." if certificates else "No vehicle changed.",
        lines=lines,
        left_out=len(certificates or rows) - len(lines),
        vehicles=sections,
        vehicles_left_out=len(fleet.vehicles) - len(sections),
        plot=PLOT_SIZE,
    )


def _certified(own: Certificate, fleet: Fleet, checks: CheckOptions) -> tuple[Any, ...]:
    """What is shown of a calibration."""
    vehicle = own.vehicle
    figures = plots(vehicle, fleet.variances) if len(vehicle.known) > 1 else []
    deviations = [] if own.verdict == ERROR else deviation_rows(own.judgement, checks.tolerance)
    recordings = [_cells(row) for row in vehicle.rows] if len(vehicle.rows) > 1 else []
    return vehicle, own, figures, deviations, [*map(_told, vehicle.changes)], recordings, pictures_of(own, checks)


def _many(count: int, what: str) -> str:
    return f"{count} {what}{'s' if count != 1 else ''}"


def pictures_of(own: Certificate, options: CheckOptions) -> list[tuple[str, Views]]:
    """A few frames, by name."""
    if own.shown is None or own.T_checked is None:
        return []
    job = own.shown.of
    options = replace(options, camera=job.camera or options.camera, frames=job.frames or options.frames)
    try:
        source = opened(job.path, options)
        positions = positions_of(source, options)
        few = [positions[k] for k in spread_positions(PICTURES, len(positions))]
        frames = read_frames(source, few, options.config, lambda share: None, None)[0]
        return [(f"frame {frame.name}", views_of(frame, own.T_checked, own.T_found, options.config)) for frame in frames]
    except CalibrationError:
        return []


def _when(time: str) -> str:
    return time.replace("T", " ").rstrip("Z")


def _told(change: VehicleChange) -> tuple[str, str, str]:
    """Vehicle, size and place of a change."""
    before, after = (f"{row.recording}, {_when(row.time)}" for row in (change.before, change.after))
    doubt = "" if change.confirmed else "; not confirmed: only the newest recording shows it"
    return change.vehicle, f"by {change_size(change)}", f"between {before}, and {after}{doubt}"


def change_size(change: VehicleChange) -> str:
    """How large a change is, and along which axes."""
    scaled = np.r_[np.rad2deg(change.value[:3]), change.value[3:]]
    clear = [k for k in range(6) if abs(scaled[k]) > TOLD * change.sigma[k]]
    axes = [f"{AXES[k]} {signed(scaled[k], k < 3)} ± {amount(change.sigma[k], k < 3)}" for k in clear]
    sizes = f"{amount(change.rotation_deg, True)}, {amount(change.translation_m, False)}"
    return f"{sizes}: {', '.join(axes)}" if axes else sizes


def _details(fleet: Fleet, false_alarms: float) -> dict[str, str]:
    sigmas = np.sqrt(fleet.variances)
    scatter = [f"{value:.2f}" for value in (*np.rad2deg(sigmas[:3]), *(100 * sigmas[3:]))]
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


def _interval(scale: float, digits: int, *known: float | None) -> Cell:
    """An error, and where it lies with 95 %."""
    if any(own is None or np.isnan(own) for own in known):
        return "-", "", "number"
    error, low, high = (scale * (own or 0.0) for own in known)
    return f"{error:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})", error, "number"


def _verdict(verdict: str) -> Cell:
    return verdict, VERDICTS.index(verdict), f"verdict-{verdict}"


def _certificate_cells(own: Certificate) -> dict[str, Cell]:
    """By caption of the column."""
    rotation, translation = ((x.error, x.low, x.high) for x in (own.judgement.rotation, own.judgement.translation))
    counts = {"recordings": len(own.vehicle.rows), "frames": own.frames, "changes": len(own.vehicle.changes)}
    return {
        "calibration": (own.vehicle.name, own.vehicle.name, "name"),
        "verdict": _verdict(own.verdict),
        "rotation, deg": _interval(1.0, 2, *rotation),
        "translation, cm": _interval(100.0, 1, *translation),
        **{name: (str(count), count, "number") for name, count in counts.items()},
    }


def _cells(row: Row) -> dict[str, Cell]:
    """By caption of the column."""

    def number(value: float | None, form: str, scale: float = 1.0) -> Cell:
        return ("-", "", "number") if value is None else (form.format(scale * value), scale * value, "number")

    sizes, drift = list(row.errors.values()), "-"
    if row.drift_deg is not None:
        drift = f"{row.drift_deg:.2f} deg, {100 * (row.drift_m or 0):.1f} cm ({row.drift_sigma:.1f} σ)"
    notes = " changed" if row.changed else " outlier" if row.outlier else ""
    return {
        "recording": (row.recording, row.path, "name"),
        "verdict": _verdict(row.verdict),
        "vehicle": (row.vehicle, row.vehicle, ""),
        "time (UTC)": (_when(row.time), row.time_ns, "number"),
        "cause": ((row.cause or "-").replace("_", " "), row.cause or "", ""),
        "rotation, deg": _interval(1.0, 2, *sizes[:3]),
        "translation, cm": _interval(100.0, 1, *sizes[3:6]),
        **{f"{axis}, deg": number(row.errors[f"{axis}_deg"], "{:+.2f}") for axis in AXES[:3]},
        **{f"{axis}, cm": number(row.errors[f"{axis}_m"], "{:+.1f}", 100.0) for axis in AXES[3:]},
        "time offset, ms": number(row.time_offset_s, "{:+.1f}", 1000.0),
        "drift": (drift + notes, row.drift_sigma or 0, "number"),
        "frames": (str(row.frames), row.frames, "number"),
        "CPU, s": number(row.cpu_s, "{:.1f}"),
        "read, MB": number(row.bytes_read, "{:.0f}", 1e-6),
        "memory, MB": number(row.peak_bytes, "{:.0f}", 1e-6),
        "message": (row.message, row.message, "words"),
    }

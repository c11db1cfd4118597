"""A rig for people, whoever says it: sensors, edges with what is left of them and loops; and these as HTML of a page, alive or
saved. Nothing is told by colour alone: levels have signs, edges have dashes. What becomes HTML is escaped here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Covariance, Transform
from calib_ros.errors import BadInputError
from calib_ros.result import BLINDED, CONVERGED, INITIAL, INSUFFICIENT, MOVED, REFUSED, SUSPECT, TENTATIVE
from calib_ros.rig.description import CAMERA, RigDescription
from calib_ros.rig.graph import PRIOR, SURE, RigSolution, at_sensor, root_information, worst_sigmas
from calib_ros.rig.live import UNCHECKED
from calib_ros.rig.report import REFERENCE, RigReport

GOOD, DOUBTFUL, BAD, NEUTRAL = "good", "doubtful", "bad", "neutral"
SIGNS = {GOOD: "✓", NEUTRAL: "○", DOUBTFUL: "▲", BAD: "✕"}
WORDS = {GOOD: "good", NEUTRAL: "nothing known yet", DOUBTFUL: "doubtful", BAD: "wrong"}
USED, DOUBTED, REJECTED, FAILED = "used", "doubted", "rejected", "failed"  # what became of an edge
LEVELS = {  # of whatever has a status: a pair, a sensor, an edge, a check
    **dict.fromkeys((CONVERGED, REFERENCE, USED, "pass"), GOOD),
    **dict.fromkeys((TENTATIVE, INITIAL, PRIOR, FAILED), NEUTRAL),
    **dict.fromkeys((REFUSED, INSUFFICIENT, SUSPECT, DOUBTED, "inconclusive"), DOUBTFUL),
    **dict.fromkeys((MOVED, BLINDED, UNCHECKED, REJECTED, "fail"), BAD),
}
# Standard deviations, in the mean of the six axes, from which on an edge is drawn otherwise, and one that is used is doubtful.
FAR, EXCESS = (0.5, 1.0), 2.0
Size = tuple[float, float]  # deg and m
LoopShown = tuple[Sequence[str], Size, float, bool]  # sensors, residual, p-value, whether it closes
NOT_ESTIMATED = "nothing is estimated: these are the priors; give a result of calib-ros rig --json with --initial"

WIDTH, BOX, ROW, HIGH = 400, 152, 50, 38  # px of the graph: whole, a box with a name, from one to the next, a box's height
LETTERS = 18  # of a name in its box; the whole is in the table
BULGE = 55  # px, of an edge between two sensors of one column
MARK_AT = 0.2  # of an edge from the camera on, to the first LiDAR; to the next ones so much farther, so that marks stand apart
PLAN, LABEL, LINE = 170, 132, 19  # px of the rig from above, of the names beside it, and of a line of these
CSS = """
.rig h2 { font-size: .95rem; font-weight: 600; line-height: 1.4; margin: 0 0 .3rem; padding: 0; border: 0; }
.rig table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .88rem; }
.rig th { text-align: left; font-weight: 600; color: var(--soft); }
.rig td, .rig th { padding: .15rem .6rem .15rem 0; border: 0; white-space: normal; }
.rig td { border-top: 1px solid var(--line); overflow-wrap: anywhere; vertical-align: top; }
.rig td:first-child { font-weight: 600; } .rig :is(td, th):last-child { width: 100%; }
@media (min-width: 801px) { .rig :is(td, th):not(:last-child, .words) { white-space: nowrap; } }
.graph { width: 100%; max-width: 34rem; display: block; margin: 0 auto; }
.graph text { fill: var(--ink); font-size: 13px; } .graph .less { fill: var(--soft); font-size: 11px; }
.good { --level: var(--good); } .neutral { --level: var(--neutral); } .doubtful { --level: var(--doubtful); }
.bad { --level: var(--bad); } .sign { color: var(--level); font-weight: 700; } .graph .sign { fill: var(--level); }
.graph path { stroke: var(--level); fill: none; stroke-width: 2.5; } .graph rect { fill: var(--card); stroke: var(--level); }
.graph .neutral path { stroke-width: 1.5; stroke-dasharray: 2 4; } .graph .doubtful path { stroke-dasharray: 9 4; }
.graph .bad path { stroke-dasharray: 3 3; } .graph circle { fill: var(--card); stroke: var(--level); }
.far1 { --level: color-mix(in oklch decreasing hue, var(--good), var(--doubtful) 40%); } .graph path.far1 { stroke-width: 3.5; }
.far2 { --level: color-mix(in oklch decreasing hue, var(--good), var(--doubtful) 75%); } .graph path.far2 { stroke-width: 4.5; }
.graph line { stroke: var(--line); } .graph .ahead { stroke: var(--ink); stroke-width: 1.5; }
@media (max-width: 800px) {
  .rig th { display: none; } .rig tr { display: block; border-top: 1px solid var(--line); padding: .25rem 0; }
  .rig td { display: inline; border: 0; } .rig td:empty { display: none; }
  .rig td[data-name]::before { content: attr(data-name) " "; color: var(--soft); font-weight: 400; }
}
"""


@dataclass(frozen=True, eq=False)
class SensorShown:
    """T: T_reference_sensor (4, 4). sigma: standard deviations of the worst directions; None = unknown. moved: its last
    displacement, None = not known to have moved. error: against what is known otherwise, in words."""

    name: str
    kind: str
    T: Transform
    status: str
    reason: str = ""
    usable: bool | None = False  # None: nobody asks
    sigma: Size | None = None
    moved: Size | None = None
    error: str = ""

    @property
    def level(self) -> str:
        """How good it is."""
        return LEVELS.get(self.status, DOUBTFUL)


@dataclass(frozen=True, eq=False)
class EdgeShown:
    """What was measured between two sensors. fate: what became of it, or the status of a pair. residual: of what was measured
    from the solution, None = nothing was; excess: the same in standard deviations of the edge, sigma."""

    target: str
    source: str
    kind: str
    fate: str
    level: str
    reason: str = ""
    residual: Size | None = None
    excess: float | None = None
    sigma: Size | None = None


@dataclass(frozen=True, eq=False)
class RigShown:
    """text: in a line, what there is to know."""

    reference: str
    sensors: tuple[SensorShown, ...]
    edges: tuple[EdgeShown, ...] = ()
    loops: tuple[LoopShown, ...] = ()
    text: str = ""

    @property
    def poses(self) -> dict[str, Transform]:
        """T_reference_sensor (4, 4) by name."""
        return {own.name: own.T for own in self.sensors}

    @property
    def cameras(self) -> list[str]:
        """Names."""
        return [own.name for own in self.sensors if own.kind == CAMERA]

    @property
    def lidars(self) -> list[str]:
        """Names, the reference first where it is one."""
        found = [own.name for own in self.sensors if own.kind != CAMERA]
        return sorted(found, key=lambda name: name != self.reference)


def compared(edge: EdgeShown, T: Transform, C: Covariance, poses: Mapping[str, Transform]) -> EdgeShown:
    """The edge with what is left of T_target_source (4, 4), measured with a covariance, by the poses. One that is used, but lies
    far from them, is doubtful."""
    edge = replace(edge, sigma=worst_sigmas(C))
    if not {edge.target, edge.source} <= poses.keys():
        return edge
    predicted = se3.inverse(poses[edge.target]) @ poses[edge.source]
    excess = float(np.sqrt(np.mean((root_information(C) @ se3.log(T @ se3.inverse(predicted))) ** 2)))
    level = DOUBTFUL if edge.level == GOOD and excess > EXCESS else edge.level
    return replace(edge, level=level, residual=se3.error(predicted, T), excess=excess)


def of_priors(description: RigDescription, solution: RigSolution) -> RigShown:
    """A rig of which only priors are known; solution: by these alone."""
    sensors = tuple(
        SensorShown(own.name, own.kind, T, REFERENCE if own.name == solution.reference else PRIOR, sigma=worst_sigmas(C))
        for own in description.sensors
        for T in (solution.poses[own.name],)
        for C in (at_sensor(T, solution.marginal(own.name)),)
    )
    return RigShown(solution.reference, sensors, text=NOT_ESTIMATED)


def of_result(data: Mapping[str, Any], solution: RigSolution) -> RigShown:
    """The result of `calib-ros rig --json`, with the solution in it. BadInputError for one that is not whole."""
    try:
        likely = [own for own in data.get("changes", ()) if own["posterior"] > SURE and own["kind"] == MOVED]
        moved = {name: (own["rotation_deg"], own["translation_m"]) for own in likely for name in own["sensors"]}
        sensors = []
        for name, T in solution.poses.items():
            own, error = data["sensors"][name], data["sensors"][name].get("reference_error")
            off = None if error is None or name == solution.reference else (error["rotation_deg"], error["translation_m"])
            sensors.append(
                SensorShown(
                    *(name, str(own["kind"]), T, str(own["status"]), str(own["reason"]), own["status"] in (CONVERGED, REFERENCE)),
                    *(worst_sigmas(at_sensor(T, solution.marginal(name))), moved.get(name), amounts(off)),
                )
            )
        edges = []
        for own in data["edges"]:
            edge = EdgeShown(
                *(own["target"], own["source"], own["kind"], own["fate"], LEVELS.get(own["fate"], NEUTRAL), own["reason"])
            )
            if (T := own["T_target_source"]) is not None:
                C = np.array(own["covariance"], float).reshape(6, 6)
                edge = compared(edge, se3.as_transform(T, "an edge"), C, solution.poses)
            edges.append(edge)
        loops = [
            (own["sensors"], (own["rotation_deg"], own["translation_m"]), own["p_value"], own["closes"]) for own in data["loops"]
        ]
    except (ValueError, TypeError, LookupError, AttributeError):
        raise BadInputError("this is no whole result of calib-ros rig; give the file that --json wrote") from None
    text = data.get("change") or summary(sensors, edges, loops)
    return RigShown(solution.reference, tuple(sensors), tuple(edges), tuple(loops), text)


def of_report(report: RigReport) -> RigShown:
    """A result that was just made, with the priors that it has rejected."""
    found = of_result(report.to_dict(), report.solution)
    priors = [e for e in report.solution.rejected if e.kind == PRIOR]
    more = tuple(EdgeShown(e.target, e.source, PRIOR, REJECTED, BAD, "the edges contradict it") for e in priors)
    return replace(found, edges=(*found.edges, *more))


def summary(sensors: Sequence[SensorShown], edges: Sequence[EdgeShown], loops: Sequence[LoopShown]) -> str:
    """How many sensors are usable, and what contradicts what."""
    parts = [f"{sum(own.usable is True for own in sensors)} of {len(sensors)} sensors usable"]
    parts += [f"{own.target}-{own.source} contradicts the others" for own in edges if own.fate == REJECTED]
    return "; ".join([*parts, *(f"loop {', '.join(names)} does not close" for names, _, _, closes in loops if not closes)])


def legend(residuals: bool = True) -> str:
    """Signs and colours of the levels; and those of what is left of good edges."""
    shown = [_signed(level, word) for level, word in WORDS.items()]
    lines = (f'<span><b class="sign good far{k}">━</b> up to {most:g}σ</span>' for k, most in enumerate((*FAR, EXCESS)))
    return " &nbsp; ".join([*shown, f"residual of an edge: {' '.join(lines)}"] if residuals else shown)


def _signed(level: str, word: str) -> str:
    return f'<span class="{level}"><span class="sign" aria-hidden="true">{SIGNS[level]}</span> {escape(word)}</span>'


def graph_svg(rig: RigShown) -> str:
    """Cameras to the left, LiDARs to the right, the reference first; between them what was measured."""
    columns = [[own for name in names for own in rig.sensors if own.name == name] for names in (rig.cameras, rig.lidars)]
    rows = max(len(column) for column in columns)
    at = {
        own.name: (0.0 if side == 0 else float(WIDTH - BOX), ROW * (k + 0.5) * rows / len(column))
        for side, column in enumerate(columns)
        for k, own in enumerate(column)
    }
    drawn = [_line(edge, at) for edge in rig.edges if edge.target in at and edge.source in at]
    for own in (own for column in columns for own in column):
        (x, y), is_reference, is_camera = at[own.name], own.name == rig.reference, own.kind == CAMERA
        usable = ", not usable" if own.usable is False and not is_reference else ""
        radius, inset, border = 4 if is_camera else HIGH / 2, 8 if is_camera else 14, 2.5 if is_reference else 1.2
        drawn.append(
            f'<g class="{own.level}"><title>{escape(f"{own.name}: {own.status}. {own.reason}")}</title>'
            f'<rect x="{x}" y="{y - HIGH / 2:.1f}" width="{BOX}" height="{HIGH}" rx="{radius}" stroke-width="{border}"/>'
            f'<text class="sign" x="{x + inset}" y="{y - 2:.1f}">{SIGNS[own.level]}</text>'
            f'<text x="{x + inset + 16}" y="{y - 2:.1f}">{_cut(own.name)}</text>'
            f'<text class="less" x="{x + inset + 16}" y="{y + 13:.1f}">{escape(own.status + usable)}</text></g>'
        )
    label = f"graph of {len(rig.sensors)} sensors and {len(rig.edges)} edges, which the table of edges lists"
    return f'<svg class="graph" viewBox="-2 0 {WIDTH + 4} {ROW * rows}" role="img" aria-label="{label}">{"".join(drawn)}</svg>'


def _cut(name: str) -> str:
    return escape(name if len(name) <= LETTERS else name[: LETTERS - 1] + "…")


def _path(edge: EdgeShown, d: str) -> str:
    far = 0 if edge.excess is None or edge.level != GOOD else int(np.searchsorted(FAR, edge.excess))
    return f'<path class="far{far}" d="{d}"/>'


def _line(edge: EdgeShown, at: dict[str, tuple[float, float]]) -> str:
    (x, y), (u, v) = sorted((at[edge.target], at[edge.source]))
    same = x == u
    side = BULGE if x == 0 else -BULGE  # into the middle
    a, b = (x + BOX if not same or x == 0 else x), (u if not same or x else u + BOX)
    path = f"M{a} {y:.1f}C{a + side} {y:.1f} {b + side} {v:.1f} {b} {v:.1f}" if same else f"M{a} {y:.1f}L{b} {v:.1f}"
    lanes = sorted({y for x, y in at.values() if x > 0})
    share = 0.5 if same else MARK_AT * (1 + min(lanes.index(v), 2))
    i, j = (a + 0.75 * side, (y + v) / 2) if same else (a + share * (b - a), y + share * (v - y))
    mark = (
        f'<circle cx="{i:.1f}" cy="{j:.1f}" r="8"/><text class="sign" x="{i:.1f}" y="{j + 4.5:.1f}" text-anchor="middle">'
        f"{SIGNS[edge.level]}</text>"
    )
    title = escape(f"{edge.target} with {edge.source}: {edge.fate} {amounts(edge.residual)} {edge.reason}".strip())
    return f'<g class="{edge.level}"><title>{title}</title>{_path(edge, path)}{mark if edge.level in (DOUBTFUL, BAD) else ""}</g>'


def plan_svg(rig: RigShown) -> str:
    """The sensors from above, x of a LiDAR reference to the right, with edges and where each looks; names stand at both sides."""
    xy = np.array([T[:2, 3] for T in rig.poses.values()]) * [1, -1]
    low, size = xy.min(axis=0), max(float(np.ptp(xy, axis=0).max()), 0.5)
    rows = -(-len(xy) // 2)
    height = max(PLAN, LINE * rows)
    centre = (size - np.ptp(xy, axis=0)) / 2
    places = np.array([LABEL + 15, (height - PLAN) / 2 + 15]) + (xy - low + centre) / size * (PLAN - 30)
    at = dict(zip(rig.poses, places, strict=True))
    drawn = []
    for edge in rig.edges:
        if edge.target in at and edge.source in at:
            (x, y), (u, v) = at[edge.target], at[edge.source]
            drawn.append(f'<g class="{edge.level}">{_path(edge, f"M{x:.1f} {y:.1f}L{u:.1f} {v:.1f}")}</g>')
    across = sorted(rig.sensors, key=lambda own: float(at[own.name][0]))
    for side, column in enumerate((across[:rows], across[rows:])):
        for k, own in enumerate(sorted(column, key=lambda own: float(at[own.name][1]))):
            (x, y), row = at[own.name], height * (k + 0.5) / len(column)
            u, v = np.array([x, y]) + 13 * own.T[:2, 2 if own.kind == CAMERA else 0] * [1, -1]
            end, anchor = (LABEL - 4, "end") if side == 0 else (LABEL + PLAN + 4, "start")
            drawn.append(
                f'<line x1="{end + (4 if side == 0 else -4)}" y1="{row:.1f}" x2="{x:.1f}" y2="{y:.1f}"/>'
                f'<line class="ahead" x1="{x:.1f}" y1="{y:.1f}" x2="{u:.1f}" y2="{v:.1f}"/>'
                f'<g class="{own.level}"><circle cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>'
                f'<text x="{end}" y="{row + 4:.1f}" text-anchor="{anchor}">{_cut(own.name)}</text></g>'
            )
    box, label = f"0 0 {PLAN + 2 * LABEL} {height}", "the sensors from above, and where each looks"
    return f'<svg class="graph" viewBox="{box}" role="img" aria-label="{label}">{"".join(drawn)}</svg>'


def amounts(size: Size | None) -> str:
    """deg and m, for people."""
    return "" if size is None else f"{size[0]:.3f}° {100 * size[1]:.1f} cm"


def sensors_html(rig: RigShown) -> str:
    """A row for each sensor."""
    rows = []
    for own in rig.sensors:
        is_reference = own.name == rig.reference
        sigma = "" if is_reference or own.usable is None else amounts(own.sigma) or "unknown"
        usable = "" if own.usable is None else "yes" if own.usable else "" if is_reference and not rig.edges else "no"
        x, y, z = own.T[:3, 3]
        cells = [usable, sigma, own.error, amounts(own.moved), f"{x:.2f} {y:.2f} {z:.2f}", own.reason]
        rows.append([escape(own.name), _signed(own.level, own.status), *map(escape, cells)])
    return _table(["sensor", "", "usable", "1σ", "error", "moved by", "x y z, m", "why"], rows)


def edges_html(rig: RigShown) -> str:
    """A row for each edge, with what is left of it."""
    rows = []
    for own in rig.edges:
        far = "" if own.excess is None else f" ({own.excess:.1f}σ)"
        cells = [own.kind, amounts(own.sigma), amounts(own.residual) + far, own.reason]
        rows.append([escape(f"{own.target} – {own.source}"), _signed(own.level, own.fate), *map(escape, cells)])
    return _table(["edge", "", "by", "1σ", "residual", "why"], rows) if rows else '<p class="soft">none measured</p>'


def loops_html(rig: RigShown) -> str:
    """A row for each loop."""
    rows = []
    for names, size, p_value, closes in rig.loops:
        told = _signed(GOOD, "closes") if closes else _signed(BAD, "does not close")
        rows.append([escape(" – ".join(names)), told, amounts(size), f"{p_value:.2g}"])
    return _table(["loop", "", "residual", "p-value"], rows) if rows else '<p class="soft">no edges close a loop</p>'


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Of cells that are HTML, without columns that have none; on a narrow screen each has its name before it, but for the first
    two."""
    kept = [k for k in range(len(header)) if k < 2 or any(row[k] for row in rows)]
    head, body = "".join(f'<th scope="col">{header[k]}</th>' for k in kept), ""
    for row in rows:
        cells = (f'<td data-name="{header[k]}">{row[k]}</td>' if k > 1 and row[k] else f"<td>{row[k]}</td>" for k in kept)
        body += f"<tr>{''.join(cells)}</tr>"
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"

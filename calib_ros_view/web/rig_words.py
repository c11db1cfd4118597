"""The page of a rig as HTML: the graph of its sensors, and tables. What becomes HTML is escaped here.

Nothing is told by colour alone: levels have signs, edges have dashes.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from calib_ros_view.session.live import BAD, DOUBTFUL, GOOD, NEUTRAL
from calib_ros_view.session.rig_shown import EdgeShown, RigShown, SensorShown

SIGNS = {GOOD: "✓", NEUTRAL: "○", DOUBTFUL: "▲", BAD: "✕"}
WORDS = {GOOD: "good", NEUTRAL: "nothing known yet", DOUBTFUL: "doubtful", BAD: "wrong"}
WIDTH, BOX, ROW, HIGH = 400, 152, 50, 38  # px of the graph: whole, a box with a name, from one to the next, a box's height
LETTERS = 18  # of a name in its box; the whole is in the table
BULGE = 55  # px, of an edge between two sensors of one column
MARK_AT = 0.3  # of an edge from the camera on, where few others are
# Blue, amber and purple stay apart for all kinds of colour vision, on both papers.
CSS = """
:root { --good: #0072b2; --doubtful: #a65f00; --bad: #a3246e; --neutral: #6b7178; }
.body--dark { --good: #56b4e9; --doubtful: #e69f00; --bad: #f08ac0; --neutral: #9aa2ab; }
.rig { display: grid; gap: .6rem; align-items: start; padding: .6rem; width: 100%; max-width: 1500px; margin: 0 auto;
  grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); }
.rig > .whole { grid-column: 1 / -1; } .rig h2 { font-size: .95rem; font-weight: 600; line-height: 1.4; margin: 0 0 .3rem; }
.rig .tiles { display: grid; gap: .6rem; grid-template-columns: repeat(auto-fill, minmax(min(100%, 15rem), 1fr)); }
.rig .tiles img { width: 100%; display: block; border-radius: 5px; background: var(--line); min-height: 4rem; }
.rig .tiles a { color: var(--accent); } .rig figcaption a { display: inline-block; margin-right: .8em; }
.rig table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .88rem; }
.rig th { text-align: left; font-weight: 600; color: var(--soft); } .rig td, .rig th { padding: .15rem .6rem .15rem 0; }
.rig td { border-top: 1px solid var(--line); overflow-wrap: anywhere; vertical-align: top; }
.rig td:first-child { font-weight: 600; } .rig :is(td, th):last-child { width: 100%; }
@media (min-width: 801px) { .rig :is(td, th):not(:last-child) { white-space: nowrap; } }
.rig svg.graph { width: 100%; max-width: 34rem; display: block; margin: 0 auto; }
.rig svg text { fill: var(--ink); font-size: 13px; } .rig svg .less { fill: var(--soft); font-size: 11px; }
.good { --level: var(--good); } .neutral { --level: var(--neutral); } .doubtful { --level: var(--doubtful); }
.bad { --level: var(--bad); } .rig .sign { color: var(--level); font-weight: 700; } .rig svg .sign { fill: var(--level); }
.rig svg path { stroke: var(--level); fill: none; stroke-width: 2.5; } .rig svg rect { fill: var(--card); stroke: var(--level); }
.rig svg .neutral path { stroke-width: 1.5; stroke-dasharray: 2 4; } .rig svg .doubtful path { stroke-dasharray: 9 4; }
.rig svg .bad path { stroke-dasharray: 3 3; } .rig svg circle { fill: var(--card); stroke: var(--level); }
@media (max-width: 800px) {
  .rig { grid-template-columns: minmax(0, 1fr); padding: .4rem; }
  .rig th { display: none; } .rig tr { display: block; border-top: 1px solid var(--line); padding: .25rem 0; }
  .rig td { display: inline; border: 0; } .rig td:empty { display: none; }
  .rig td[data-name]::before { content: attr(data-name) " "; color: var(--soft); font-weight: 400; }
}
"""


def legend() -> str:
    """Signs and colours of the levels."""
    return " &nbsp; ".join(f'<span class="{level}">{_sign(level)} {word}</span>' for level, word in WORDS.items())


def _sign(level: str) -> str:
    return f'<span class="sign" aria-hidden="true">{SIGNS[level]}</span>'


def graph_svg(rig: RigShown) -> str:
    """Cameras to the left, LiDARs to the right, the reference first; between them what was measured."""
    columns = [[own for own in rig.sensors if own.name in names] for names in (rig.cameras, rig.lidars)]
    columns[1].sort(key=lambda own: own.name != rig.reference)
    rows = max(len(column) for column in columns)
    at = {
        own.name: (0.0 if side == 0 else float(WIDTH - BOX), ROW * (k + 0.5) * rows / len(column))
        for side, column in enumerate(columns)
        for k, own in enumerate(column)
    }
    drawn = [_line(edge, at) for edge in rig.edges if edge.target in at and edge.source in at]
    drawn += [_box(own, *at[own.name], own.name == rig.reference) for column in columns for own in column]
    label = f"graph of {len(rig.sensors)} sensors and {len(rig.edges)} edges, which the table of edges lists"
    return f'<svg class="graph" viewBox="-2 0 {WIDTH + 4} {ROW * rows}" role="img" aria-label="{label}">{"".join(drawn)}</svg>'


def _box(own: SensorShown, x: float, y: float, is_reference: bool) -> str:
    name = own.name if len(own.name) <= LETTERS else own.name[: LETTERS - 1] + "…"
    usable = "" if own.usable or is_reference else ", not usable"
    radius = 4 if own.kind == "camera" else HIGH / 2
    inset, border = 8 if own.kind == "camera" else 14, 2.5 if is_reference else 1.2
    return (
        f'<g class="{own.level}"><title>{escape(f"{own.name}: {own.status}. {own.reason}")}</title>'
        f'<rect x="{x}" y="{y - HIGH / 2:.1f}" width="{BOX}" height="{HIGH}" rx="{radius}" stroke-width="{border}"/>'
        f'<text class="sign" x="{x + inset}" y="{y - 2:.1f}">{SIGNS[own.level]}</text>'
        f'<text x="{x + inset + 16}" y="{y - 2:.1f}">{escape(name)}</text>'
        f'<text class="less" x="{x + inset + 16}" y="{y + 13:.1f}">{escape(own.status + usable)}</text></g>'
    )


def _line(edge: EdgeShown, at: dict[str, tuple[float, float]]) -> str:
    (x, y), (u, v) = sorted((at[edge.target], at[edge.source]))
    same = x == u
    side = BULGE if x == 0 else -BULGE  # into the middle
    a, b = (x + BOX if not same or x == 0 else x), (u if not same or x else u + BOX)
    path = f"M{a} {y:.1f}C{a + side} {y:.1f} {b + side} {v:.1f} {b} {v:.1f}" if same else f"M{a} {y:.1f}L{b} {v:.1f}"
    share = 0.5 if same else MARK_AT
    i, j = (a + 0.75 * side, (y + v) / 2) if same else (a + share * (b - a), y + share * (v - y))
    mark = (
        f'<circle cx="{i:.1f}" cy="{j:.1f}" r="8"/><text class="sign" x="{i:.1f}" y="{j + 4.5:.1f}" text-anchor="middle">'
        f"{SIGNS[edge.level]}</text>"
    )
    title = escape(f"{edge.target} with {edge.source}: {edge.fate} {amounts(edge.residual)} {edge.reason}".strip())
    return f'<g class="{edge.level}"><title>{title}</title><path d="{path}"/>{mark if edge.level in (DOUBTFUL, BAD) else ""}</g>'


def amounts(size: tuple[float, float] | None) -> str:
    """deg and m, for people."""
    return "" if size is None else f"{size[0]:.3f}° {100 * size[1]:.1f} cm"


def sensors_html(rig: RigShown) -> str:
    """A row for each sensor."""
    rows = []
    for own in rig.sensors:
        status = f'<span class="{own.level}">{_sign(own.level)} {escape(own.status)}</span>'
        is_reference = own.name == rig.reference
        sigma = "" if is_reference else amounts(own.sigma) or "unknown"
        x, y, z = own.T[:3, 3]
        usable = "yes" if own.usable else "" if is_reference and not rig.edges else "no"
        place = f"{x:.2f} {y:.2f} {z:.2f}"
        rows.append([escape(own.name), status, usable, sigma, amounts(own.moved), place, escape(own.reason)])
    return _table(["sensor", "", "usable", "1σ", "moved by", "x y z, m", "why"], rows)


def edges_html(rig: RigShown) -> str:
    """A row for each edge, with what is left of it."""
    rows = []
    for own in rig.edges:
        fate = f'<span class="{own.level}">{_sign(own.level)} {escape(own.fate)}</span>'
        left = "" if own.residual is None else f"{amounts(own.residual)} ({own.excess:.1f}σ)"
        rows.append([escape(f"{own.target} – {own.source}"), fate, escape(own.kind), left, escape(own.reason)])
    return _table(["edge", "", "by", "residual", "why"], rows) if rows else '<p class="soft">none measured</p>'


def loops_html(rig: RigShown) -> str:
    """A row for each loop."""
    rows = []
    for own in rig.loops:
        level = GOOD if own.closes else BAD
        closes = f'<span class="{level}">{_sign(level)} {"closes" if own.closes else "does not close"}</span>'
        size = amounts((own.rotation_deg, own.translation_m))
        rows.append([escape(" – ".join(own.sensors)), closes, size, f"{own.p_value:.2g}"])
    return _table(["loop", "", "residual", "p-value"], rows) if rows else '<p class="soft">no edges close a loop</p>'


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Of cells that are HTML; on a narrow screen each has its name before it, but for the first two."""
    head = "".join(f'<th scope="col">{name}</th>' for name in header)
    body = "".join(f"<tr>{''.join(_cell(k, header[k], cell) for k, cell in enumerate(row))}</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _cell(k: int, name: str, content: str) -> str:
    return f'<td data-name="{name}">{content}</td>' if k > 1 and content else f"<td>{content}</td>"

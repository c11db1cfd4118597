"""What the live page says, and its style: actions and keys, the status in words, figures, events and keyframes as HTML.

Names and reasons come from the network: what becomes HTML is escaped here.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros.registration.judgement.refusal import joined, lines_of
from calib_ros_check.rig.shown import BAD, DOUBTFUL, GOOD, NEUTRAL
from calib_ros_check.tolerance import TITLES
from calib_ros_view.node.calls import CALIBRATE, CAPTURE, CHECK, RESET, SAVE, NodeClient
from calib_ros_view.session.live import Event, LiveHistory

if TYPE_CHECKING:
    from calib_ros_msgs.msg import KeyframePicture
    from calib_ros_msgs.srv import Check

LEVEL_COLOURS = {GOOD: "#2ea043", DOUBTFUL: "#d29922", BAD: "#e5534b", NEUTRAL: "#8b949e"}
SHARED = {"d, t": "dark or light", "?": "these keys"}
KEYS_OF_RIG = {"n / p": "next / previous moment of a recording", **SHARED}
CSS = """
.live { display: grid; gap: .6rem; align-items: start; padding: .6rem; width: 100%; max-width: 1500px; margin: 0 auto;
  grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); overflow-wrap: anywhere; }
.live > .whole { grid-column: 1 / -1; }
.live .charts { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 12px; width: 100%; }
.live .badge { color: #fff; border-radius: 8px; padding: 4px 14px; font-size: 1.35rem; font-weight: 650; line-height: 1.5; }
.live .numbers { margin: .6rem 0 .3rem; display: grid; gap: 8px 16px; width: 100%;
  grid-template-columns: repeat(auto-fill, minmax(150px, 1fr)); }
.live .numbers b { display: block; font-size: 1.1rem; font-variant-numeric: tabular-nums; font-weight: 600; }
.live .numbers span { font-size: .75rem; color: var(--soft); }
.live .strip { height: 22px; border-radius: 6px; width: 100%; background-clip: padding-box; background-repeat: no-repeat;
  cursor: crosshair; border: 1px solid var(--line); }
.live .tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(190px, 1fr)); gap: 10px; width: 100%; }
.live .soft { white-space: pre-line; } .live .large { grid-template-columns: repeat(auto-fill, minmax(min(100%, 15rem), 1fr)); }
.live .tiles figure { margin: 0; } .live figcaption { font-size: .75rem; color: var(--soft); font-variant-numeric: tabular-nums; }
.live .tiles img { width: 100%; border-radius: 6px; display: block; background: var(--line); min-height: 2.5rem; }
.live .tiles a { color: var(--accent); } .live figcaption a { display: inline-block; margin-right: .8em; }
.live .events { max-height: 420px; overflow-y: auto; }
.live .events div { display: grid; grid-template-columns: 76px 1fr; gap: 8px; padding: 3px 0 3px 8px;
  border-left: 3px solid; font-size: .85rem; }
.live .events time { color: var(--soft); font-variant-numeric: tabular-nums; } .live .events p { margin: 0; }
@media (max-width: 800px) { .live, .live .charts { grid-template-columns: minmax(0, 1fr); } .live { padding: .4rem; } }
"""
FIGURES = {
    "monitor p-value": "monitor p-value", "keyframes in the buffer": "keyframes",
    "estimates accepted": "estimates accepted", "age of the last estimate, s": "last estimate, s ago",
    "images per s": "images/s", "clouds per s": "clouds/s", "pairs per s": "pairs/s",
    "pairs dropped by a busy worker": "pairs dropped", "CPU, share of a core": "CPU, of a core",
}  # fmt: skip
Options = dict[str, Any]
X, Y, Z = "#e5534b", "#2ea043", "#4a90e2"
GREY, RULE = "#8b949e", "rgba(139,148,158,0.22)"
AMBER, VIOLET = "#d29922", "#a371f7"
COLOURS = {
    "converged": "#2ea043", "tentative": "#4a90e2", "initial": "#8b949e", "refused": "#d29922", "insufficient": "#d29922",
    "suspect": "#e8912d", "moved": "#e5534b", "blinded": "#b62324", "gone": "rgba(139,148,158,0.35)",
}  # fmt: skip
SMALLEST_P = 1e-6
CLOCK = {"hour": "{HH}:{mm}", "minute": "{HH}:{mm}", "second": "{HH}:{mm}:{ss}"}


@dataclass(frozen=True)
class Action:
    """A service with a button. question: asked before it is called."""

    service: str
    key: str
    label: str
    icon: str
    question: str = ""


ACTIONS = (
    Action(CALIBRATE, "c", "Calibrate", "my_location", "Search and estimate now? An accepted estimate replaces the extrinsic."),
    Action(CHECK, "k", "Check", "fact_check"),
    Action(SAVE, "s", "Save", "save", "Write the state file, from which the node starts next time?"),
    Action(CAPTURE, "p", "Capture", "inventory_2", "Write the raw frames of the newest keyframes as a bag on the node's disk?"),
    Action(RESET, "r", "Reset", "restart_alt", "Forget all keyframes, and go back to the initial extrinsic?"),
)  # fmt: skip
KEYS_OF_PAIR = {action.key: f"{action.label}: ~/{action.service}" for action in ACTIONS} | {
    "g": "draw the keyframes anew", "o": "overlay on or off", "1 2 3": "the last 5 min, 15 min, hour",
    "Enter, Esc": "yes or no to a question", "Esc": "stop the calibration", **SHARED,
}  # fmt: skip


class Said(NamedTuple):
    """badge: the status, and its colour. usable: in words, or nothing. words: what it means. reason: why it is so. advice: what
    to do, or nothing."""

    badge: str
    colour: str
    usable: str
    words: str
    reason: str
    advice: str = ""


def said_of(watch: NodeClient, now: float) -> Said:
    """The status of the node, or where it is; to be called under the watch's lock."""
    history = watch.history
    state = history.state
    if history.heard is None:
        seen = watch.nodes_seen()
        words = f"No node {watch.name} is heard in ROS domain {watch.domain_id}. The page goes on once it is."
        hint = (
            "To check: is the node running, active, and called so (--node)? Has it the same ROS_DOMAIN_ID, "
            f"discovery range and RMW_IMPLEMENTATION? Nodes seen: {', '.join(seen) if seen else 'none'}."
        )
        return Said("waiting", COLOURS["initial"], "", words, hint)
    if history.gone:
        hint = (
            "ROS still lists it: it hangs, is not active, or ended moments ago."
            if watch.name in watch.nodes_seen()
            else "ROS lists it no more: it has ended."
        )
        words = f"Node gone since {clock(history.heard)}. {hint}"
        return Said(
            "gone", LEVEL_COLOURS[BAD], "not usable", words, "It comes back by itself; what is shown below is the last known."
        )
    if state is None:
        return Said(
            "heard", COLOURS["initial"], "", "The node is there; its extrinsic is still to come.", history.diagnosis.message
        )
    problem = history.diagnosis.message if history.diagnosis.level else ""
    own = state.result.reason.strip(" :;")
    for sign in ":;":  # the badge says the status already
        problem = problem.removeprefix(f"{state.result.status}{sign} ")
    reason = "\n".join(lines_of(problem if own in problem else joined([own, problem])))
    status, usable = state.result.status, "usable" if state.usable else "not usable"
    return Said(status, COLOURS.get(status, LEVEL_COLOURS[state.level]), usable, state.words, reason, state.advice)


def numbers_html(history: LiveHistory) -> str:
    """Figures of the newest extrinsic and of the newest diagnostics, as HTML."""
    state, diagnosis = history.state, history.diagnosis
    cells: list[tuple[str, str]] = []
    if state is not None:
        result = state.result
        cells += [("score", _number(result.score, 3)), ("drift", _number(state.drift, 2))]
        cells += [("frames used", str(result.frames_used)), ("age of the data, s", _number(state.data_age_s, 1))]
        if result.covariance is not None:
            sigma = np.sqrt(np.diag(result.covariance))
            cells.append(("1σ rotation, °", _number(float(np.rad2deg(sigma[:3].max())), 3)))
            cells.append(("1σ translation, cm", _number(100 * float(sigma[3:].max()), 1)))
        if result.time_offset_s is not None:
            cells.append(("clock offset, ms", _number(1000 * result.time_offset_s, 1)))
    cells += [(label, diagnosis.values[name]) for name, label in FIGURES.items() if name in diagnosis.values]
    notes = {"Monitor": diagnosis.values.get("monitor", "none"), "Last check": diagnosis.check}
    check = "".join(f'<p class="soft text-sm">{name}: {escape(said)}</p>' for name, said in notes.items())
    shown = "".join(f"<div><span>{escape(n)}</span><b>{escape(v)}</b></div>" for n, v in cells)
    return f'<div class="numbers">{shown}</div>{check}'


def legend_html(statuses: list[str]) -> str:
    """The statuses in the colours of the strip."""
    return " &nbsp; ".join(f'<span style="color:{COLOURS.get(s, GREY)}">■</span> {escape(s)}' for s in statuses)


def event_html(event: Event) -> str:
    """An event with its time, and how often it came."""
    times = f" <b>×{event.count}</b>" if event.count > 1 else ""
    return (
        f'<div style="border-color:{LEVEL_COLOURS[event.level]}"><time>{clock(event.at)}</time>'
        f"<p>{escape(event.text)}{times}</p></div>"
    )


def tile_html(tile: KeyframePicture, address: str) -> str:
    """A keyframe of the gallery. address: of its picture."""
    score = "too little in view" if math.isnan(tile.score) else f"score {tile.score:.2f}"
    age = "newest" if tile.age <= 0 else f"{tile.age:.1f} s older"
    return (
        f'<figure><img src="{address}" alt="keyframe, {age}" loading="lazy">'
        f"<figcaption>{age} · {score} · {tile.in_view} of {tile.edge_points} edge points</figcaption></figure>"
    )


def words_of_check(response: Check.Response) -> list[str]:
    """What a check has found: another cause, rotation and translation in all, and axis by axis."""
    if not response.success:
        return []
    lines = [response.cause_message] if response.cause_message else []
    found = (response.rotation, response.translation, *response.axes)
    lines += [f"{TITLES.get(own.name, own.name)}: {own.words}" for own in found if own.words]
    return lines + list(response.notes)


def clock(at: float) -> str:
    """The time of day."""
    return time.strftime("%H:%M:%S", time.localtime(at))


def ago(seconds: float) -> str:
    """How long ago, for a person."""
    return "just now" if seconds < 2 else f"{seconds:.0f} s ago" if seconds < 120 else f"{seconds / 60:.0f} min ago"


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else "none"


def charts(poses: Matrix, measures: Matrix, since: float, now: float) -> list[Options]:
    """Rotation and translation with their 2-sigma bands; drift on the left axis, the monitor's p-value on the right one; images,
    clouds and pairs per second, CPU time on the right axis. poses, measures: of `LiveHistory`."""
    made = []
    for first, unit, names in (
        (1, "°", ("pitch (x)", "yaw (y)", "roll (z)")),
        (4, "cm", ("right (x)", "down (y)", "forward (z)")),
    ):
        series: list[Options] = []
        for k, (name, colour) in enumerate(zip(names, (X, Y, Z), strict=True)):
            value, sigma = poses[:, first + k], poses[:, first + k + 6]
            # A band of its own entry in the legend would be one too many: it shares the name, and so the switch, of its line.
            band = {"name": name, "type": "line", "symbol": "none", "silent": True, "stack": f"band {k}", "stackStrategy": "all"}
            band |= {"lineStyle": {"opacity": 0}, "tooltip": {"show": False}, "color": colour}
            series.append({**band, "data": points(poses[:, 0], value - 2 * sigma)})
            series.append({**band, "data": points(poses[:, 0], 4 * sigma), "areaStyle": {"opacity": 0.13}})
            series.append(_line(name, colour, points(poses[:, 0], value)))
        made.append(_chart(series, since, now, unit))
    times, shaded = measures[:, 0], {"areaStyle": {"opacity": 0.08}}
    p = [[t, max(v, SMALLEST_P) if v is not None else None] for t, v in points(times, measures[:, 1], 9)]
    series = [{**_line("drift", AMBER, points(poses[:, 0], poses[:, 13])), **shaded}]
    series.append({**_line("p-value", VIOLET, p), "yAxisIndex": 1, "step": "end"})
    made.append(_chart(series, since, now, "", {**_axis(""), "type": "log", "min": SMALLEST_P, "max": 1}))
    rates = (("images/s", X, 2), ("clouds/s", Z, 3), ("pairs/s", Y, 4))
    series = [_line(name, colour, points(times, measures[:, k], 1)) for name, colour, k in rates]
    series.append({**_line("CPU", AMBER, points(times, 100 * measures[:, 5], 1)), "yAxisIndex": 1, **shaded})
    return [*made, _chart(series, since, now, "", {**_axis(" %"), "min": 0})]


def _chart(series: Sequence[Options], since: float, now: float, unit: str, right: Options | None = None) -> Options:
    """A chart over time. right: a second axis; the left one begins at 0 then."""
    left = _axis(unit)
    return {
        "animation": False, "textStyle": {"color": GREY}, "backgroundColor": "transparent",
        "grid": {"left": 52, "right": 14 if right is None else 52, "top": 34, "bottom": 26},
        "legend": {"data": list(dict.fromkeys(own["name"] for own in series)), "top": 0, "textStyle": {"color": GREY},
                   "icon": "roundRect", "itemWidth": 12, "itemHeight": 4},
        "tooltip": {"trigger": "axis", "confine": True},
        "xAxis": {  # the same window for all charts, so that what is above each other belongs together
            "type": "time", "min": round(1000 * since), "max": round(1000 * now),
            "axisLabel": {"color": GREY, "hideOverlap": True, "formatter": CLOCK},
            "axisLine": {"lineStyle": {"color": RULE}}, "splitLine": {"show": False},
        },
        "yAxis": left if right is None else [{**left, "scale": False, "min": 0}, {**right, "splitLine": {"show": False}}],
        "series": list(series),
    }  # fmt: skip


def _axis(unit: str) -> Options:
    """Of values. Labels are whatever ECharts finds round, with the unit."""
    label, rule = {"color": GREY, "formatter": f"{{value}}{unit}"}, {"lineStyle": {"color": RULE}}
    return {"type": "value", "scale": True, "axisLabel": label, "splitLine": rule}


def _line(name: str, colour: str, data: list[list[float | None]]) -> Options:
    """Without symbols; broken at gaps."""
    line = {"type": "line", "symbol": "none", "lineStyle": {"width": 2}, "connectNulls": False}
    return {"name": name, "color": colour, "data": data, **line}


def points(times: Matrix, values: Matrix, decimals: int = 3) -> list[list[float | None]]:
    """Times in ms, and values, rounded: they go over the wire as text. NaN becomes a gap."""
    return [
        [round(1000 * t), None if not math.isfinite(v) else round(v, decimals)]
        for t, v in zip(times.tolist(), values.tolist(), strict=True)
    ]


def strip_css(spans: Sequence[tuple[float, float, str]], since: float, now: float) -> str:
    """Statuses over time as a CSS gradient with hard stops; transparent before the first."""
    total, stops = max(now - since, 1e-3), ["transparent 0%"]
    for k, (begin, end, status) in enumerate(spans):
        left, right = 100 * (begin - since) / total, 100 * (end - since) / total
        if k == 0:
            stops.append(f"transparent {left:.2f}%")
        colour = COLOURS.get(status, GREY)
        stops += [f"{colour} {left:.2f}%", f"{colour} {right:.2f}%"]
    return f"linear-gradient(90deg, {', '.join(stops)})"

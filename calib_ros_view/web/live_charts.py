"""The charts of the live page as options of ECharts. Colours suit a dark and a light page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from calib_ros.arrays import Matrix

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


def poses_chart(rows: Matrix, translation: bool, since: float, now: float) -> Options:
    """Three axes with their 2-sigma bands. rows: of `LiveHistory.poses`."""
    first, unit = (4, "cm") if translation else (1, "°")
    names = ("right (x)", "down (y)", "forward (z)") if translation else ("pitch (x)", "yaw (y)", "roll (z)")
    series: list[Options] = []
    for k, (name, colour) in enumerate(zip(names, (X, Y, Z), strict=True)):
        value, sigma = rows[:, first + k], rows[:, first + k + 6]
        band = {"type": "line", "symbol": "none", "silent": True, "stack": f"band {k}", "stackStrategy": "all"}
        band |= {"lineStyle": {"opacity": 0}, "tooltip": {"show": False}, "color": colour}
        # A band of its own entry in the legend would be one too many: it shares the name, and so the switch, of its line.
        series.append({**band, "name": name, "data": points(rows[:, 0], value - 2 * sigma)})
        series.append({**band, "name": name, "data": points(rows[:, 0], 4 * sigma), "areaStyle": {"opacity": 0.13}})
        series.append(line(name, colour, points(rows[:, 0], value)))
    return chart(series, since, now, unit, list(names))


def drift_chart(poses: Matrix, measures: Matrix, since: float, now: float) -> Options:
    """Drift on the left axis, the monitor's p-value on the right one, logarithmic."""
    p = [[t, max(v, SMALLEST_P) if v is not None else None] for t, v in points(measures[:, 0], measures[:, 1], 9)]
    series = [
        {**line("drift", AMBER, points(poses[:, 0], poses[:, 13])), "areaStyle": {"opacity": 0.08}},
        {**line("p-value", VIOLET, p), "yAxisIndex": 1, "step": "end"},
    ]
    right = {**value_axis(""), "type": "log", "min": SMALLEST_P, "max": 1}
    return _with_right_axis(chart(series, since, now, "", ["drift", "p-value"]), right)


def rates_chart(measures: Matrix, since: float, now: float) -> Options:
    """Images, clouds and pairs per second on the left axis, CPU time on the right one."""
    times = measures[:, 0]
    series = [line(name, colour, points(times, measures[:, k], 1)) for k, name, colour in
              ((2, "images/s", X), (3, "clouds/s", Z), (4, "pairs/s", Y))]  # fmt: skip
    load = line("CPU", AMBER, points(times, 100 * measures[:, 5], 1))
    series.append({**load, "yAxisIndex": 1, "areaStyle": {"opacity": 0.08}})
    options = chart(series, since, now, "", ["images/s", "clouds/s", "pairs/s", "CPU"])
    return _with_right_axis(options, {**value_axis(" %"), "min": 0})


def _with_right_axis(options: Options, right: Options) -> Options:
    """The left axis begins at 0."""
    options["yAxis"] = [{**options["yAxis"], "scale": False, "min": 0}, {**right, "splitLine": {"show": False}}]
    options["grid"]["right"] = 52
    return options


def chart(series: Sequence[Options], since: float, now: float, unit: str, legend: list[str]) -> Options:
    """Options of a chart over time."""
    return {
        "animation": False, "textStyle": {"color": GREY}, "backgroundColor": "transparent",
        "grid": {"left": 52, "right": 14, "top": 34, "bottom": 26},
        "legend": {"data": legend, "top": 0, "textStyle": {"color": GREY}, "icon": "roundRect", "itemWidth": 12, "itemHeight": 4},
        "tooltip": {"trigger": "axis", "confine": True},
        "xAxis": {  # the same window for all charts, so that what is above each other belongs together
            "type": "time", "min": round(1000 * since), "max": round(1000 * now),
            "axisLabel": {"color": GREY, "hideOverlap": True, "formatter": CLOCK},
            "axisLine": {"lineStyle": {"color": RULE}}, "splitLine": {"show": False},
        },
        "yAxis": value_axis(unit), "series": list(series),
    }  # fmt: skip


def value_axis(unit: str) -> Options:
    """An axis of values. Labels are whatever ECharts finds round, with the unit."""
    return {
        "type": "value", "scale": True, "axisLabel": {"color": GREY, "formatter": f"{{value}}{unit}"},
        "splitLine": {"lineStyle": {"color": RULE}},
    }  # fmt: skip


def line(name: str, colour: str, data: list[list[float | None]]) -> Options:
    """A line without symbols; broken at gaps."""
    return {
        "name": name, "type": "line", "symbol": "none", "color": colour, "lineStyle": {"width": 2}, "data": data,
        "connectNulls": False,
    }  # fmt: skip


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

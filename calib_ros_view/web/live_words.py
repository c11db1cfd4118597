"""What the live page says, and its style: actions and keys, the status in words, figures, events and keyframes as HTML.

Names and reasons come from the network: what becomes HTML is escaped here.
"""

from __future__ import annotations

import html
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calib_ros_check.rig.shown import BAD, DOUBTFUL, GOOD, NEUTRAL
from calib_ros_view.node.calls import CALIBRATE, CAPTURE, CHECK, RESET, SAVE, Answer, NodeClient
from calib_ros_view.session.live import Event, LiveHistory, Presence
from calib_ros_view.session.motion import AXES
from calib_ros_view.web.live_charts import COLOURS, GREY

if TYPE_CHECKING:
    from calib_ros_msgs.msg import KeyframePicture
    from calib_ros_msgs.srv import Check

LEVEL_COLOURS = {GOOD: "#2ea043", DOUBTFUL: "#d29922", BAD: "#e5534b", NEUTRAL: "#8b949e"}
GONE = "gone"


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
SHARED = {"d, t": "dark or light", "?": "these keys"}
KEYS_OF_RIG = {"n / p": "next / previous moment of a recording", **SHARED}
KEYS_OF_PAIR = {action.key: f"{action.label}: ~/{action.service}" for action in ACTIONS} | {
    "g": "draw the keyframes anew", "o": "overlay on or off", "1 2 3": "the last 5 min, 15 min, hour",
    "Enter, Esc": "yes or no to a question", "Esc": "stop the calibration", **SHARED,
}  # fmt: skip
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
.live .large { grid-template-columns: repeat(auto-fill, minmax(min(100%, 15rem), 1fr)); }
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


@dataclass(frozen=True)
class Said:
    """badge: the status. level: how good it is. usable: in words, or nothing. words: what it means. reason: why it is so. advice:
    what to do, or nothing."""

    badge: str
    level: str
    usable: str
    words: str
    reason: str
    advice: str = ""

    @property
    def colour(self) -> str:
        """Of the badge."""
        return LEVEL_COLOURS[self.level] if self.badge == GONE else COLOURS.get(self.badge, LEVEL_COLOURS[self.level])


def said_of(watch: NodeClient, now: float) -> Said:
    """The status of the node, or where it is; to be called under the watch's lock."""
    history = watch.history
    state, presence = history.state, history.presence
    if presence is Presence.WAITING:
        seen = watch.nodes_seen()
        words = f"No node {watch.name} is heard in ROS domain {watch.domain_id}. The page goes on once it is."
        hint = (
            "To check: is the node running, active, and called so (--node)? Has it the same ROS_DOMAIN_ID, "
            f"discovery range and RMW_IMPLEMENTATION? Nodes seen: {', '.join(seen) if seen else 'none'}."
        )
        return Said("waiting", NEUTRAL, "", words, hint)
    if presence is Presence.GONE:
        hint = (
            "ROS still lists it: it hangs, is not active, or ended moments ago."
            if watch.name in watch.nodes_seen()
            else "ROS lists it no more: it has ended."
        )
        words = f"Node gone since {clock(history.heard or now)}. {hint}"
        return Said(GONE, BAD, "not usable", words, "It comes back by itself; what is shown below is the last known.")
    if state is None:
        return Said("heard", NEUTRAL, "", "The node is there; its extrinsic is still to come.", history.diagnosis.message)
    problem = history.diagnosis.message if history.diagnosis.level else ""
    own = state.result.reason.strip(" :;")
    for sign in ":;":  # the badge says the status already
        problem = problem.removeprefix(f"{state.result.status}{sign} ")
    told, cause = problem if own in problem else "; ".join(filter(None, [own, problem])), state.result.cause
    reason = told if cause is None else f"{cause.words}: {told}"
    return Said(state.result.status, state.level, "usable" if state.usable else "not usable", state.words, reason, state.advice)


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
    check = "".join(f'<p class="soft text-sm">{name}: {_text(said)}</p>' for name, said in notes.items())
    shown = "".join(f"<div><span>{_text(n)}</span><b>{_text(v)}</b></div>" for n, v in cells)
    return f'<div class="numbers">{shown}</div>{check}'


def legend_html(statuses: list[str]) -> str:
    """The statuses in the colours of the strip."""
    return " &nbsp; ".join(f'<span style="color:{COLOURS.get(s, GREY)}">■</span> {_text(s)}' for s in statuses)


def _text(value: str) -> str:
    return html.escape(value)


def event_html(event: Event) -> str:
    """An event with its time, and how often it came."""
    times = f" <b>×{event.count}</b>" if event.count > 1 else ""
    return (
        f'<div style="border-color:{LEVEL_COLOURS[event.level]}"><time>{clock(event.at)}</time>'
        f"<p>{_text(event.text)}{times}</p></div>"
    )


def tile_html(tile: KeyframePicture, address: str) -> str:
    """A keyframe of the gallery. address: of its picture."""
    score = "too little in view" if math.isnan(tile.score) else f"score {tile.score:.2f}"
    age = "newest" if tile.age <= 0 else f"{tile.age:.1f} s older"
    return (
        f'<figure><img src="{address}" alt="keyframe, {age}" loading="lazy">'
        f"<figcaption>{age} · {score} · {tile.in_view} of {tile.edge_points} edge points</figcaption></figure>"
    )


def words_of_answer(service: str, at: float, answer: Answer) -> str:
    """What a service has answered, and what a check has found."""
    text = f"{'✓' if answer.success else '✗'} {clock(at)} ~/{service} ({answer.seconds:.1f} s): {answer.message}"
    return "\n".join([text, *(words_of_check(answer.response) if service == CHECK and answer.response is not None else ())])


def words_of_check(response: Check.Response) -> list[str]:
    """What a check has found: another cause, rotation and translation in all, and axis by axis."""
    if not response.success:
        return []
    lines = [response.cause_message] if response.cause_message else []
    titles = {"rotation": "rotation", "translation": "translation", **{axis.name: axis.title for axis in AXES}}
    found = (response.rotation, response.translation, *response.axes)
    lines += [f"{titles.get(own.name, own.name)}: {own.words}" for own in found if own.words]
    return lines + list(response.notes)


def clock(at: float) -> str:
    """The time of day."""
    return time.strftime("%H:%M:%S", time.localtime(at))


def ago(seconds: float) -> str:
    """How long ago, for a person."""
    return "just now" if seconds < 2 else f"{seconds:.0f} s ago" if seconds < 120 else f"{seconds / 60:.0f} min ago"


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else "none"

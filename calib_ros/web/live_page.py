"""The live page: one node over the last hour, its pictures, and buttons for its services.

`LivePage(watch)` has the page and the routes of its pictures for `calib_ros.web.server.serve`. Everything shown is the watch's,
so that all clients see the same; per client there are only the window of time, the reference and the switch of the overlay.
"""

from __future__ import annotations

import asyncio
import html
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from fastapi import FastAPI, Response
from nicegui import ui
from nicegui.events import KeyEventArguments

from calib_ros.ros.watch import CALIBRATE, CAPTURE, CHECK, RESET, SAVE, Tile, Watch, tiles, words_of_check
from calib_ros.view.live import BAD, DOUBTFUL, GOOD, HOUR, NEUTRAL, Event, Matrix, Presence
from calib_ros.web import live_charts

CHARTS_S = 3.0  # between updates of the charts; everything else is updated once a second
WINDOWS = {300: "5 min", 900: "15 min", 3600: "1 h"}
REFERENCES = {"first": "first heard", "newest": "newest"}
LEVEL_COLOURS = {GOOD: "#2ea043", DOUBTFUL: "#d29922", BAD: "#e5534b", NEUTRAL: "#8b949e"}
GONE = "gone"
NO_STORE = {"Cache-Control": "no-store"}
EVENTS_SHOWN = 60


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
KEYS = (
    *((action.key, f"{action.label}: ~/{action.service}") for action in ACTIONS),
    ("g", "draw the keyframes anew"), ("o", "overlay on or off"), ("1 2 3", "the last 5 min, 15 min, hour"),
    ("d", "dark or light"), ("?", "these keys"), ("Enter, Esc", "yes or no to a question"),
)  # fmt: skip
CSS = """
.live { max-width: 1400px; margin: 0 auto; width: 100%; gap: 12px; padding: 12px; }
.live .box { border: 1px solid rgba(139,148,158,.3); border-radius: 10px; padding: 12px; width: 100%; min-width: 0; }
.live .grid2 { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 12px; width: 100%; }
.live .title { font-size: .8rem; letter-spacing: .04em; opacity: .7; font-weight: 600; }
.live .badge { color: #fff; border-radius: 8px; padding: 4px 14px; font-size: 1.35rem; font-weight: 650; line-height: 1.5; }
.live .numbers { display: grid; grid-template-columns: repeat(auto-fill, minmax(150px, 1fr)); gap: 8px 16px; width: 100%; }
.live .numbers b { display: block; font-size: 1.1rem; font-variant-numeric: tabular-nums;
  font-weight: 600; overflow-wrap: anywhere; }
.live .numbers span { font-size: .75rem; opacity: .7; }
.live .strip { height: 22px; border-radius: 6px; width: 100%; border: 1px solid rgba(139,148,158,.3); }
.live .tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(190px, 1fr)); gap: 10px; width: 100%; }
.live .tiles figure { margin: 0; } .live .tiles img { width: 100%; border-radius: 6px; display: block; }
.live .tiles figcaption { font-size: .75rem; opacity: .8; font-variant-numeric: tabular-nums; }
.live .overlay { width: 100%; border-radius: 6px; display: block; }
.live .events { max-height: 420px; overflow-y: auto; width: 100%; }
.live .events div { display: grid; grid-template-columns: 76px 1fr; gap: 8px; padding: 3px 0 3px 8px;
  border-left: 3px solid; font-size: .85rem; }
.live .events time { opacity: .7; font-variant-numeric: tabular-nums; } .live .events p { margin: 0; overflow-wrap: anywhere; }
.live p.muted { margin: 6px 0 0; }
.live .muted { opacity: .7; font-size: .85rem; } .live .wrap { overflow-wrap: anywhere; }
.live button:focus-visible, .live [tabindex]:focus-visible { outline: 3px solid #4a90e2; outline-offset: 2px; }
@media (max-width: 800px) { .live .grid2 { grid-template-columns: minmax(0, 1fr); } .live { padding: 8px; } }
"""


class LivePage:
    """The page of one node, and what its clients share: the keyframes drawn last."""

    def __init__(self, watch: Watch) -> None:
        self.watch = watch
        self.tiles: list[Tile] = []
        self.gallery_note = "not asked for yet"
        self.gallery_at = 0.0

    def page(self) -> None:
        """Build the page of a client."""
        _View(self).build()

    def routes(self, app: FastAPI) -> None:
        """Add the addresses of the pictures. They are in memory: no path of the disk is made of a request."""

        @app.get("/live/overlay.jpg")
        def overlay() -> Response:
            jpeg = self.watch.overlay.jpeg
            return Response(jpeg, 200 if jpeg else 404, NO_STORE, "image/jpeg")

        @app.get("/live/keyframe/{stamp}.jpg")
        def keyframe(stamp: int) -> Response:
            found = [tile.jpeg for tile in self.tiles if tile.stamp == stamp]
            return Response(found[0] if found else b"", 200 if found else 404, NO_STORE, "image/jpeg")

    async def draw_keyframes(self) -> None:
        """Ask the node for pictures; clients that ask meanwhile share the answer."""
        answer = await asyncio.wrap_future(self.watch.keyframes())
        if answer.success:
            self.tiles = tiles(answer)
            drawn, ms = len(self.tiles), 1000 * answer.response.cpu
            self.gallery_note = f"{drawn} keyframe{'s' * (drawn != 1)}, drawn in {ms:.0f} ms of the node's CPU time"
        else:
            self.gallery_note = answer.message
        self.gallery_at = time.time()


class _View:
    """The page of one client."""

    def __init__(self, page: LivePage) -> None:
        self.page, self.watch = page, page.watch
        self.window, self.reference = 3600, "first"
        self.looker: int | None = None
        self.overlay_number = -1
        self.gallery_shown = -1.0
        self.events_shown: list[Event] | None = None
        self.charts_due = 0.0

    # ---- made once ----------------------------------------------------------------------------------------------------

    def build(self) -> None:
        """Everything on the page; once a second it is brought up to date as long as the client is there."""
        ui.add_css(CSS)
        self.dark = ui.dark_mode(None)
        with ui.column().classes("live"):
            with ui.row().classes("w-full items-center justify-between no-wrap"):
                ui.label(f"{self.watch.name}").classes("text-lg font-bold wrap").props("role=heading aria-level=1")
                with ui.row().classes("no-wrap gap-1"):
                    ui.button(icon="contrast", on_click=self.switch_theme).props('flat round aria-label="dark or light"')
                    ui.button(icon="keyboard", on_click=lambda: self.help.open()).props('flat round aria-label="keys"')
            self._build_status()
            self._build_actions()
            self._build_timeline()
            with ui.element("div").classes("grid2"):
                self._build_overlay()
                self._build_events()
            self._build_gallery()
        self._build_help()
        ui.keyboard(self.on_key, ignore=["input", "select", "textarea"], repeating=False)
        client = ui.context.client
        client.on_connect(self.look)
        client.on_disconnect(self.leave)
        client.on_delete(self.leave)
        self.update()
        ui.timer(1.0, self.update)
        if time.time() - self.page.gallery_at > 30:
            ui.timer(0.5, self.page.draw_keyframes, once=True)

    def _build_status(self) -> None:
        with ui.column().classes("box gap-2").props("role=status aria-live=polite"):
            with ui.row().classes("items-center gap-3"):
                self.badge = ui.label().classes("badge")
                self.usable = ui.label().classes("font-medium")
            self.words = ui.label().classes("wrap")
            self.reason = ui.label().classes("muted wrap")
            self.numbers = ui.html("", sanitize=False).classes("w-full")

    def _build_actions(self) -> None:
        self.buttons: dict[str, ui.button] = {}
        with ui.column().classes("box gap-2"):
            with ui.row().classes("gap-2"):
                for action in ACTIONS:
                    button = ui.button(action.label, icon=action.icon, on_click=lambda a=action: self.ask(a)).props(
                        "outline no-caps"
                    )
                    button.tooltip(f"key {action.key}")
                    self.buttons[action.service] = button
            self.answer = ui.label("Answers of the node appear here.").classes("muted wrap").props("aria-live=polite")
            self.details = ui.label().classes("muted wrap").style("white-space: pre-line")
        with ui.dialog() as self.dialog, ui.card():
            self.question = ui.label()
            with ui.row().classes("w-full justify-end"):
                ui.button("No", on_click=self.dialog.close).props("flat")
                ui.button("Yes", on_click=self.confirm).props("autofocus")
        self.asked: Action | None = None

    def _build_timeline(self) -> None:
        with ui.column().classes("box gap-2"):
            with ui.row().classes("w-full items-center justify-between"):
                ui.label("Timeline").classes("title")
                with ui.row().classes("gap-2"):
                    ui.toggle(REFERENCES, value=self.reference, on_change=lambda e: self.choose(reference=e.value)).props(
                        'dense no-caps size=sm aria-label="relative to"'
                    ).tooltip("what the extrinsic is shown relative to")
                    self.windows = ui.toggle(WINDOWS, value=self.window, on_change=lambda e: self.choose(window=e.value)).props(
                        'dense no-caps size=sm aria-label="how long"'
                    )
            self.strip = ui.element("div").classes("strip").props('role=img aria-label="status over time"')
            self.legend = ui.html("", sanitize=False).classes("muted")
            with ui.element("div").classes("grid2"):
                names = ("Rotation, with 2σ", "Translation, with 2σ", "Drift, and the monitor's p-value", "Rates and load")
                self.charts = [self._chart(name) for name in names]

    def _chart(self, name: str) -> ui.echart:
        with ui.column().classes("gap-0 w-full").style("min-width: 0"):
            ui.label(name).classes("title")
            return ui.echart({"series": []}).style("height: 210px; width: 100%")

    def _build_overlay(self) -> None:
        with ui.column().classes("box gap-2"):
            with ui.row().classes("w-full items-center justify-between"):
                ui.label("Overlay").classes("title")
                self.switch = ui.switch("live", value=True, on_change=self.switch_overlay).props("dense")
            self.overlay_note = ui.label("waits for a picture: one comes with the next pair of image and cloud").classes("muted")
            self.picture = ui.element("img").classes("overlay").props('alt="points and edges over the image"')
            self.picture.set_visibility(False)

    def _build_events(self) -> None:
        with ui.column().classes("box gap-2"):
            ui.label("Events").classes("title")
            self.events = ui.html("", sanitize=False).classes("events").props('tabindex=0 role=log aria-label="events"')

    def _build_gallery(self) -> None:
        with ui.column().classes("box gap-2"):
            with ui.row().classes("w-full items-center justify-between"):
                ui.label("Keyframes: edges of the image, and those of the scan in colours of their depth").classes("title")
                ui.button("Draw", icon="refresh", on_click=self.page.draw_keyframes).props("flat dense no-caps").tooltip("key g")
            self.gallery_note = ui.label().classes("muted wrap")
            self.gallery = ui.html("", sanitize=False).classes("w-full")

    def _build_help(self) -> None:
        with ui.dialog() as self.help, ui.card():
            ui.label("Keys").classes("text-lg")
            with ui.element("div").style("display: grid; grid-template-columns: auto 1fr; gap: 4px 16px"):
                for key, meaning in KEYS:
                    ui.label(key).classes("font-mono font-bold")
                    ui.label(meaning)
            ui.button("Close", on_click=self.help.close).props("flat autofocus")

    # ---- what the client does -----------------------------------------------------------------------------------------

    def on_key(self, event: KeyEventArguments) -> None:
        """Keys work wherever the focus is, but not behind a dialog, nor with Ctrl, Alt or Meta."""
        if not event.action.keydown or event.modifiers.ctrl or event.modifiers.alt or event.modifiers.meta:
            return
        if self.dialog.value or self.help.value:
            return
        key = str(event.key)
        keys: dict[str, Callable[[], object]] = {action.key: lambda a=action: self.ask(a) for action in ACTIONS}  # type: ignore[misc]
        keys |= {"?": self.help.open, "d": self.switch_theme, "o": lambda: self.switch.set_value(not self.switch.value)}
        keys |= {str(k + 1): lambda w=window: self.windows.set_value(w) for k, window in enumerate(WINDOWS)}  # type: ignore[misc]
        if key == "g":
            ui.timer(0, self.page.draw_keyframes, once=True)
        elif key in keys:
            keys[key]()

    def switch_theme(self) -> None:
        """Dark or light; at first as the browser has it."""
        self.dark.value = self.dark.value is not True

    def choose(self, window: int | None = None, reference: str | None = None) -> None:
        """Another window of time or reference, at once."""
        self.window, self.reference, self.charts_due = window or self.window, reference or self.reference, 0.0
        self.update()

    def ask(self, action: Action) -> None:
        """Call a service; one that changes something only after a yes."""
        if action.service in self.watch.busy:
            return
        if not action.question:
            self.watch.call(action.service)
            self.update()
            return
        self.asked = action
        self.question.text = action.question
        self.dialog.open()

    def confirm(self) -> None:
        """Yes to the question. What the node answers is shown to all clients, whether this one is still there or not."""
        self.dialog.close()
        if self.asked is not None:
            self.watch.call(self.asked.service)
        self.asked = None
        self.update()

    def switch_overlay(self) -> None:
        """The switch was moved."""
        if self.switch.value:
            self.look()
        else:
            self.leave()

    def look(self) -> None:
        """The client is there, and wants the overlay."""
        if self.looker is None and self.switch.value:
            self.looker = self.watch.look()

    def leave(self) -> None:
        """The client is gone, or does not want it."""
        if self.looker is not None:
            self.watch.leave(self.looker)
            self.looker = None

    # ---- once a second ------------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Bring everything up to date that has changed."""
        now = time.time()
        with self.watch.lock:
            history = self.watch.history
            self._update_status(now)
            events = history.newest_events(EVENTS_SHOWN)
            since = max(now - min(self.window, HOUR), history.started) if now - history.started > 60 else now - 60
            strip = history.strip(since, now)
            drawn = now >= self.charts_due
            if drawn:
                self.charts_due = now + CHARTS_S
                state = history.state
                reference = state.result.T_camera_lidar if self.reference == "newest" and state is not None else None
                poses, measures = history.poses(since, reference), history.measures.rows(since, 300)
        self.strip.style(f"background: {live_charts.strip_css(strip, since, now)}")
        seen = dict.fromkeys(status for _, _, status in strip)
        self.legend.content = " &nbsp; ".join(
            f'<span style="color:{live_charts.COLOURS.get(s, live_charts.GREY)}">■</span> {_text(s)}' for s in seen
        )
        if drawn:
            self._update_charts(poses, measures, since, now)
        if events != self.events_shown:
            self.events_shown = events
            self.events.content = "".join(map(_event_html, events)) or '<p class="muted">nothing yet</p>'
        self._update_answers()
        self._update_pictures(now)

    def _update_status(self, now: float) -> None:
        history = self.watch.history
        state, presence = history.state, history.presence
        if presence is Presence.WAITING:
            seen = self.watch.nodes_seen()
            words = f"No node {self.watch.name} is heard in ROS domain {self.watch.domain_id}. The page goes on once it is."
            hint = (
                "To check: is the node running, active, and called so (--node)? Has it the same ROS_DOMAIN_ID and "
                f"ROS_AUTOMATIC_DISCOVERY_RANGE? Nodes seen: {', '.join(seen) if seen else 'none'}."
            )
            self._say("waiting", NEUTRAL, "", words, hint)
        elif presence is Presence.GONE:
            listed = self.watch.name in self.watch.nodes_seen()
            hint = (
                "ROS still lists it: it hangs, is not active, or ended moments ago."
                if listed
                else "ROS lists it no more: it has ended."
            )
            self._say(
                GONE,
                BAD,
                "not usable",
                f"Node gone since {_clock(history.heard or now)}. {hint}",
                "It comes back by itself; what is shown below is the last known.",
            )
        elif state is None:
            self._say("heard", NEUTRAL, "", "The node is there; its extrinsic is still to come.", history.diagnosis.message)
        else:
            problem = history.diagnosis.message if history.diagnosis.level else ""
            own = state.result.reason.strip(" :;")
            reason = problem if own in problem else "; ".join(filter(None, [own, problem]))
            self._say(state.result.status, state.level, "usable" if state.usable else "not usable", state.words, reason)
        self.numbers.content = self._numbers()

    def _say(self, badge: str, level: str, usable: str, words: str, reason: str) -> None:
        self.badge.text, self.usable.text, self.words.text, self.reason.text = badge, usable, words, reason
        colour = live_charts.COLOURS.get(badge, LEVEL_COLOURS[level])
        self.badge.style(f"background: {LEVEL_COLOURS[level] if badge == GONE else colour}")

    def _numbers(self) -> str:
        history = self.watch.history
        state, diagnosis = history.state, history.diagnosis
        cells: list[tuple[str, str]] = []
        if state is not None:
            result = state.result
            cells += [
                ("score", _number(result.score, 3)),
                ("drift", _number(state.drift, 2)),
                ("frames used", str(result.frames_used)),
            ]
            cells.append(("age of the data, s", _number(state.data_age_s, 1)))
            if result.time_offset_s is not None:
                cells.append(("clock offset, ms", _number(1000 * result.time_offset_s, 1)))
        wanted = {
            "sigma of rotation, deg": "1σ rotation, °", "sigma of translation, m": "1σ translation, m",
            "monitor p-value": "monitor p-value", "keyframes in the buffer": "keyframes",
            "estimates accepted": "estimates accepted", "age of the last estimate, s": "last estimate, s ago",
            "images per s": "images/s", "clouds per s": "clouds/s", "pairs per s": "pairs/s",
            "pairs dropped by a busy worker": "pairs dropped", "CPU, share of a core": "CPU, of a core",
        }  # fmt: skip
        cells += [(label, diagnosis.values[name]) for name, label in wanted.items() if name in diagnosis.values]
        notes = {"Monitor": diagnosis.values.get("monitor", "none"), "Last check": diagnosis.check}
        check = "".join(f'<p class="muted">{name}: {_text(said)}</p>' for name, said in notes.items())
        shown = "".join(f"<div><span>{_text(n)}</span><b>{_text(v)}</b></div>" for n, v in cells)
        return f'<div class="numbers">{shown}</div>{check}'

    def _update_charts(self, poses: Matrix, measures: Matrix, since: float, now: float) -> None:
        options = (
            live_charts.poses_chart(poses, False, since, now),
            live_charts.poses_chart(poses, True, since, now),
            live_charts.drift_chart(poses, measures, since, now),
            live_charts.rates_chart(measures, since, now),
        )
        for chart, made in zip(self.charts, options, strict=True):
            chart.options.clear()
            chart.options.update(made)
            chart.update()

    def _update_answers(self) -> None:
        busy, answers = self.watch.busy, dict(self.watch.answers)
        for service, button in self.buttons.items():
            button.set_enabled(service not in busy)
            button.props(add="loading" if service in busy else "", remove="" if service in busy else "loading")
        if answers:
            service, (at, answer) = list(answers.items())[-1]
            mark = "✓" if answer.success else "✗"
            self.answer.text = f"{mark} {_clock(at)} ~/{service} ({answer.seconds:.1f} s): {answer.message}"
            self.details.text = (
                "\n".join(words_of_check(answer.response)) if service == CHECK and answer.response is not None else ""
            )

    def _update_pictures(self, now: float) -> None:
        overlay = self.watch.overlay
        if overlay.number and overlay.number != self.overlay_number:
            self.overlay_number = overlay.number
            self.picture.props(f'src="/live/overlay.jpg?n={overlay.number}"')
            self.picture.set_visibility(True)
        if overlay.number:
            self.overlay_note.text = f"drawn {_ago(now - overlay.at)}; before: initial extrinsic, after: current one"
        if self.page.gallery_at != self.gallery_shown:
            self.gallery_shown = self.page.gallery_at
            self.gallery.content = f'<div class="tiles">{"".join(map(_tile_html, self.page.tiles))}</div>'
        age = f", {_ago(now - self.page.gallery_at)}" if self.page.gallery_at else ""
        self.gallery_note.text = self.page.gallery_note + age


def _text(value: str) -> str:
    """Safe as HTML: names and reasons come from the network."""
    return html.escape(value)


def _event_html(event: Event) -> str:
    times = f" <b>×{event.count}</b>" if event.count > 1 else ""
    return (
        f'<div style="border-color:{LEVEL_COLOURS.get(event.level, "#8b949e")}"><time>{_clock(event.at)}</time>'
        f"<p>{_text(event.text)}{times}</p></div>"
    )


def _tile_html(tile: Tile) -> str:
    score = "too little in view" if math.isnan(tile.score) else f"score {tile.score:.2f}"
    age = "newest" if tile.age_s <= 0 else f"{tile.age_s:.1f} s older"
    return (
        f'<figure><img src="/live/keyframe/{tile.stamp}.jpg" alt="keyframe, {age}" loading="lazy">'
        f"<figcaption>{age} · {score} · {tile.in_view} of {tile.edge_points} edge points</figcaption></figure>"
    )


def _clock(at: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(at))


def _ago(seconds: float) -> str:
    return "just now" if seconds < 2 else f"{seconds:.0f} s ago" if seconds < 120 else f"{seconds / 60:.0f} min ago"


def _number(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if math.isfinite(value) else "none"

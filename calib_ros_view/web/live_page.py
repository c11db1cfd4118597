"""The live page: one node over the last hour, its pictures, and buttons for its services.

Everything shown is the watch's, so that all clients see the same; per client there are only the window of time, the reference
and the switch of the overlay.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial

from nicegui import ui
from nicegui.events import GenericEventArguments, KeyEventArguments

from calib_ros.arrays import Matrix
from calib_ros_view.node.watch import CHECK, Watch
from calib_ros_view.session.live import HOUR, Event, Presence, moment_of
from calib_ros_view.web import live_charts, theme
from calib_ros_view.web.live_words import (
    ACTIONS,
    CSS,
    KEYS,
    Action,
    ago,
    clock,
    event_html,
    legend_html,
    numbers_html,
    said_of,
    tile_html,
    words_of_check,
)
from calib_ros_view.web.server import Pictures

CHARTS_S = 3.0  # between updates of the charts; everything else is updated once a second
WINDOWS = {300: "5 min", 900: "15 min", 3600: "1 h"}
REFERENCES = {"first": "first heard", "newest": "newest", "moment": "at"}
WHERE_CLICKED = "(e) => emit(e.offsetX / e.currentTarget.clientWidth)"  # on the strip, 0..1
EVENTS_SHOWN = 60


class LivePage:
    """The page of one node, and what its clients share: the keyframes drawn last.

    back: address of the page that it belongs to, "" = none. other: whether another page is to be shown at its place, which
    loading it again brings.
    """

    def __init__(self, watch: Watch, pictures: Pictures, back: str = "", other: Callable[[], bool] = lambda: False) -> None:
        self.watch, self.pictures, self.back, self.other = watch, pictures, back, other
        self.gallery = ""
        self.gallery_note = "not asked for yet"
        self.gallery_at = 0.0
        self.drawn_of = 0  # keyframes in the buffer when they were drawn last

    def page(self) -> None:
        """Build the page of a client."""
        _ClientPage(self).build()

    async def draw_keyframes(self) -> None:
        """Ask the node for pictures; clients that ask meanwhile share the answer."""
        answer = await asyncio.wrap_future(self.watch.keyframes())
        if answer.success:
            tiles = [
                tile_html(tile, self.pictures.put(f"keyframe {k}{self.watch.name}", bytes(tile.data)))
                for k, tile in enumerate(answer.response.keyframes)
            ]
            self.gallery = "".join(tiles)
            drawn, ms = len(tiles), 1000 * answer.response.cpu
            self.gallery_note = f"{drawn} keyframe{'s' * (drawn != 1)}, drawn in {ms:.0f} ms of the node's CPU time"
        else:
            self.gallery_note = answer.message
        self.gallery_at = time.time()

    def is_due(self, keyframes: int) -> bool:
        """Whether to draw without being asked: there are twice as many in the buffer as when that was said last."""
        if 0 < keyframes < 2 * self.drawn_of:
            return False
        self.drawn_of = keyframes
        return keyframes > 0


class _ClientPage:
    """The page of one client."""

    def __init__(self, page: LivePage) -> None:
        self.page, self.watch = page, page.watch
        self.window, self.reference, self.moment = 3600, "first", time.time()
        self.shown_from = self.shown_to = self.moment
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
        self.help = theme.keys_dialog(KEYS)
        with ui.column().classes("live"):
            with ui.row().classes("w-full items-center justify-between no-wrap"):
                ui.label(f"{self.watch.name}").classes("text-lg font-bold wrap").props("role=heading aria-level=1")
                with ui.row().classes("no-wrap gap-1"):
                    if self.page.back:
                        theme.icon_button("hub", "all sensors of the rig", partial(ui.navigate.to, self.page.back))
                    theme.icon_button("contrast", "dark or light", partial(theme.switch, self.dark), "d")
                    theme.icon_button("keyboard", "keys", self.help.open, "?")
            self._build_status()
            self._build_actions()
            self._build_timeline()
            with ui.element("div").classes("grid2"):
                self._build_overlay()
                self._build_events()
            self._build_gallery()
        ui.keyboard(self.on_key, ignore=["input", "select", "textarea"], repeating=False)
        client = ui.context.client
        client.on_connect(self.look)
        client.on_disconnect(self.leave)
        client.on_delete(self.leave)
        self.update()
        ui.timer(1.0, self.update)
        if time.time() - self.page.gallery_at > 30:
            self.page.drawn_of = 0

    def _build_status(self) -> None:
        with ui.column().classes("box gap-2").props("role=status aria-live=polite"):
            with ui.row().classes("items-center gap-3"):
                self.badge = ui.label().classes("badge")
                self.usable = ui.label().classes("font-medium")
            self.words = ui.label().classes("wrap")
            self.reason = ui.label().classes("muted wrap")
            self.advice = ui.label().classes("wrap")
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
            with ui.row().classes("w-full items-center no-wrap gap-3") as self.progress:
                self.stage = ui.label().classes("muted").style("min-width: 7em")
                self.bar = ui.linear_progress(0.0, show_value=False, size="6px").classes("grow")
                ui.button("Stop", on_click=self.watch.stop).props("dense no-caps color=negative unelevated").tooltip("key Esc")
            self.answer = ui.label("Answers of the node appear here.").classes("muted wrap").props("aria-live=polite")
            self.details = ui.label().classes("muted wrap").style("white-space: pre-line")
        with ui.dialog() as self.dialog, ui.card():
            self.question = ui.label()
            with ui.row().classes("w-full justify-end"):
                ui.button("No", on_click=self.dialog.close).props("flat no-caps")
                ui.button("Yes", on_click=self.confirm).props("autofocus no-caps")
        self.asked: Action | None = None

    def _build_timeline(self) -> None:
        with ui.column().classes("box gap-2"):
            with ui.row().classes("w-full items-center justify-between"):
                ui.label("Timeline").classes("title")
                with ui.row().classes("gap-2 items-center"):
                    ui.label("relative to").classes("muted")
                    self.references = ui.toggle(
                        REFERENCES, value=self.reference, on_change=lambda e: self.choose(reference=e.value)
                    ).props('dense no-caps aria-label="relative to"')
                    self.moment_input = ui.input(value=clock(self.moment), on_change=self.choose_moment).props(
                        'type=time step=1 dense outlined aria-label="time of the extrinsic that the charts are relative to"'
                    )
                    self.moment_input.bind_visibility_from(self.references, "value", lambda value: value == "moment")
                    self.windows = ui.toggle(WINDOWS, value=self.window, on_change=lambda e: self.choose(window=e.value)).props(
                        'dense no-caps aria-label="how long"'
                    )
            self.strip = ui.element("div").classes("strip").props('role=img aria-label="status over time"')
            self.strip.on("click", self.strip_clicked, js_handler=WHERE_CLICKED)
            self.strip.tooltip("a click shows the extrinsic relative to that moment")
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

    # ---- what the client does -----------------------------------------------------------------------------------------

    def on_key(self, event: KeyEventArguments) -> None:
        """Keys work wherever the focus is."""
        key = theme.pressed(event, self.dialog, self.help)
        keys: dict[str, Callable[[], object]] = {action.key: lambda a=action: self.ask(a) for action in ACTIONS}  # type: ignore[misc]
        keys |= {
            "?": self.help.open,
            "Escape": self.watch.stop,
            "d": partial(theme.switch, self.dark),
            "o": lambda: self.switch.set_value(not self.switch.value),
        }
        keys |= {str(k + 1): lambda w=window: self.windows.set_value(w) for k, window in enumerate(WINDOWS)}  # type: ignore[misc]
        if key == "g":
            ui.timer(0, self.page.draw_keyframes, once=True)
        elif key in keys:
            keys[key]()

    def choose(self, window: int | None = None, reference: str | None = None) -> None:
        """Another window of time or reference, at once."""
        self.window, self.reference, self.charts_due = window or self.window, reference or self.reference, 0.0
        self.update()

    def choose_moment(self) -> None:
        """A time of day was typed, or set by a click on the strip; one that is incomplete changes nothing."""
        moment = moment_of(str(self.moment_input.value), time.time())
        if moment is not None:
            self.moment = moment
            self.choose()

    def strip_clicked(self, event: GenericEventArguments) -> None:
        """Relative to the moment that was clicked on."""
        share = event.args if isinstance(event.args, (int, float)) else 1.0
        at = self.shown_from + min(max(float(share), 0.0), 1.0) * (self.shown_to - self.shown_from)
        self.references.value = "moment"
        self.moment_input.value = clock(at)

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
        (self.look if self.switch.value else self.leave)()

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
        if self.page.other():
            ui.navigate.reload()
            return
        with self.watch.lock:
            history = self.watch.history
            said = said_of(self.watch, now)
            self.numbers.content = numbers_html(history)
            events = history.newest_events(EVENTS_SHOWN)
            since = max(now - min(self.window, HOUR), history.started) if now - history.started > 60 else now - 60
            strip = history.strip(since, now)
            drawn = now >= self.charts_due
            if drawn:
                self.charts_due = now + CHARTS_S
                poses, measures = history.poses(since, self._reference()), history.measures.rows(since, 300)
        self.shown_from, self.shown_to = since, now
        self.badge.text, self.usable.text, self.words.text, self.reason.text = said.badge, said.usable, said.words, said.reason
        self.advice.text = f"To do: {said.advice}" if said.advice else ""
        self.badge.style(f"background: {said.colour}")
        self.strip.style(f"background-image: {live_charts.strip_css(strip, since, now)}")
        self.legend.content = legend_html(list(dict.fromkeys(status for _, _, status in strip)))
        if drawn:
            self._update_charts(poses, measures, since, now)
        if events != self.events_shown:
            self.events_shown = events
            self.events.content = "".join(map(event_html, events)) or '<p class="muted">nothing yet</p>'
        self._update_answers()
        self._update_pictures(now)

    def _reference(self) -> Matrix | None:
        """T_camera_lidar (4, 4) that the charts are relative to; None = the first one heard."""
        history = self.watch.history
        if self.reference == "newest":
            return None if history.state is None else history.state.result.T_camera_lidar
        return history.pose_at(self.moment) if self.reference == "moment" else None

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
        progress = self.watch.progress
        self.progress.set_visibility(progress is not None)
        if progress is not None:
            self.stage.text, self.bar.value = progress[0] or "waits its turn", progress[1]
        if answers:
            service, (at, answer) = list(answers.items())[-1]
            mark = "✓" if answer.success else "✗"
            self.answer.text = f"{mark} {clock(at)} ~/{service} ({answer.seconds:.1f} s): {answer.message}"
            self.details.text = (
                "\n".join(words_of_check(answer.response)) if service == CHECK and answer.response is not None else ""
            )

    def _update_pictures(self, now: float) -> None:
        overlay = self.watch.overlay
        if overlay.number and overlay.number != self.overlay_number:
            self.overlay_number = overlay.number
            address = self.page.pictures.put(f"overlay{self.watch.name}", overlay.jpeg)
            self.picture.props(f'src="{address}"')
            self.picture.set_visibility(True)
        if overlay.number:
            self.overlay_note.text = f"drawn {ago(now - overlay.at)}; before: initial extrinsic, after: current one"
        if self.page.gallery_at != self.gallery_shown:
            self.gallery_shown = self.page.gallery_at
            self.gallery.content = f'<div class="tiles">{self.page.gallery}</div>'
        history = self.watch.history
        keyframes = history.diagnosis.number("keyframes in the buffer")
        if history.presence is Presence.LIVE and keyframes >= 0 and self.page.is_due(int(keyframes)):
            ui.timer(0, self.page.draw_keyframes, once=True)
        age = f", {ago(now - self.page.gallery_at)}" if self.page.gallery_at else ""
        self.gallery_note.text = self.page.gallery_note + age

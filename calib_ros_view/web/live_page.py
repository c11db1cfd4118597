"""The live page: a node over the last hour, or a rig, running or recorded, with all its sensors. A pair is what a link of that
opens, and all there is of a node without a rig.

Everything shown is the feed's, so that all browsers see the same; each has its own window of time, reference, and switch of the
overlay only.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from nicegui import run, ui
from nicegui.events import GenericEventArguments, KeyEventArguments

from calib_ros_check.rig import shown as html
from calib_ros_view.node.calls import CHECK
from calib_ros_view.session.live import HOUR, Event, Pair, moment_of
from calib_ros_view.session.rig_session import RigSession
from calib_ros_view.web import live_words as words
from calib_ros_view.web import theme
from calib_ros_view.web.live_words import ACTIONS, CSS, KEYS_OF_PAIR, KEYS_OF_RIG, Action
from calib_ros_view.web.panels import RigScene
from calib_ros_view.web.server import Pictures

if TYPE_CHECKING:
    from calib_ros_view.node.watch import Watch

CHARTS_S = 3.0  # between updates of the charts; everything else is updated once a second
CHARTS = ("Rotation, with 2σ", "Translation, with 2σ", "Drift, and the monitor's p-value", "Rates and load")
WINDOWS = {300: "5 min", 900: "15 min", 3600: "1 h"}
REFERENCES = {"first": "first heard", "newest": "newest", "moment": "at"}
WHERE_CLICKED = "(e) => emit(e.offsetX / e.currentTarget.clientWidth)"  # on the strip, 0..1
EVENTS_SHOWN = 60
FORGOTTEN_S = 30.0  # after which keyframes that were drawn are drawn anew for who opens the page


def live_page(feed: Watch | RigSession, pictures: Pictures, gallery: Gallery | None = None, back: str = "") -> None:
    """Build the page for one browser. gallery: of a node. back: address of the page that it belongs to, "" = none."""
    part: RigView | PairView
    if isinstance(feed, RigSession) or gallery is None or feed.rig is not None:
        part, keys = RigView(feed, pictures), KEYS_OF_RIG
    else:
        part, keys = PairView(feed, gallery, pictures), KEYS_OF_PAIR
    ui.add_css(html.CSS + CSS)
    with theme.bar(feed.name, keys, back) as (switch, listed):
        if isinstance(part, RigView):
            part.build_bar()
        ui.space()
    with ui.element("main").classes("rig live"):
        part.build()
    part.keys |= {"?": listed.open, "t": switch, "d": switch}

    def on_key(event: KeyEventArguments) -> None:
        key = theme.pressed(event, listed, *part.dialogs)
        if key in part.keys:
            part.keys[key]()

    ui.keyboard(on_key, ignore=["input", "select", "textarea"], repeating=False)
    ui.timer(1.0, part.update)


def _part(title: str, whole: bool = False) -> ui.element:
    part = ui.element("section").classes("card p-2 min-w-0" + " whole" * whole)
    if title:
        with part:
            ui.html(f"<h2>{title}</h2>", sanitize=False)
    return part


def _html() -> ui.html:
    return ui.html("", sanitize=False).classes("w-full")


class RigView:
    """All sensors of a rig."""

    def __init__(self, feed: Watch | RigSession, pictures: Pictures) -> None:
        self._feed, self._pictures = feed, pictures
        self.dialogs: list[ui.dialog] = []
        self.keys: dict[str, Callable[[], object]] = {}
        self._seen, self._busy = -1, False
        self._tiles: dict[str, ui.element] = {}
        self._links: dict[str, Sequence[Pair]] = {}

    def build_bar(self) -> None:
        """Where one is in a recording."""
        if isinstance(self._feed, RigSession):
            theme.icon_button("chevron_left", "previous moment", partial(self._go, -1), "p")
            self._moment = ui.label().classes("figures text-sm")
            theme.icon_button("chevron_right", "next moment", partial(self._go, 1), "n")
            self.keys = {key: partial(ui.timer, 0, partial(self._go, by), once=True) for key, by in (("p", -1), ("n", 1))}

    def build(self) -> None:
        """Pictures, graph, tables, clouds."""
        with _part("", whole=True).props("role=status aria-live=polite"):
            self._text = ui.label().mark("summary")
            self._problem = ui.label().classes("bad sign").mark("problem")
            ui.html(html.legend(), sanitize=False).classes("text-xs soft")
        with _part("Cameras, with the points of their LiDARs"):
            self._grid = ui.element("div").classes("tiles large")
        shown = {html.graph_svg: "Sensors and edges", html.sensors_html: "Sensors", html.edges_html: "Edges"}
        self._told = {}
        for make, title in shown.items():
            with _part(title, whole=make is not html.graph_svg):
                self._told[make] = _html()
        with _part("Clouds and cameras, in the frame of the reference"):
            self._scene = RigScene()
        with _part("Loops"):
            self._told[html.loops_html] = _html()

    async def _go(self, by: int) -> None:
        if not self._busy and isinstance(self._feed, RigSession):
            self._busy = True
            try:
                await run.io_bound(self._feed.go, by)
            finally:
                self._busy = False
            await self.update()

    async def update(self) -> None:
        """Show what has changed."""
        feed, rig = self._feed, self._feed.rig
        if not isinstance(feed, RigSession):
            feed.look()
        if rig is None:
            return
        await self._scene.show(rig, dict(feed.clouds), feed.corners)
        if self._seen == feed.version:
            return
        self._seen = feed.version
        self._text.text, self._problem.text = rig.text, feed.problem
        self._problem.set_visibility(bool(feed.problem))
        if isinstance(feed, RigSession):
            self._moment.text = f"{feed.moment + 1} of {len(feed.moments)}"
        for make, part in self._told.items():
            if part.content != (content := make(rig)):
                part.set_content(content)
        # Only addresses of pictures change, so that a link keeps the focus, unless there are others.
        links = {tile: feed.pairs_of(tile) for tile in sorted(feed.tiles)}
        if links != self._links:
            self._links = links
            self._grid.clear()
            with self._grid:
                self._tiles = {tile: self._tile(tile, pairs) for tile, pairs in links.items()}
        for tile, picture in self._tiles.items():
            picture.props(f'src="{self._pictures.put(f"rig {tile}", feed.tiles[tile])}"')

    def _tile(self, tile: str, pairs: Sequence[Pair]) -> ui.element:
        addresses = {" with ".join(pair): f"/pair/{'/'.join(pair)}" for pair in pairs}
        with ui.element("figure").classes("m-0"):
            for name, address in list(addresses.items())[:1]:
                with ui.link(target=address).props(f'aria-label="open {name}"'):
                    picture = ui.element("img")
            if not pairs:
                picture = ui.element("img")
            with ui.element("figcaption").classes("text-sm"):
                for name, address in addresses.items():
                    ui.link(name, address)
                if not pairs:
                    ui.label(f"{tile}: no LiDAR's points are in view")
        return picture.props(f'alt="{tile}, with points over the image"')


class Gallery:
    """The keyframes that a node has drawn last, for all browsers."""

    def __init__(self, watch: Watch, pictures: Pictures) -> None:
        self._watch, self._pictures = watch, pictures
        self.content, self.note, self.at = "", "not asked for yet", 0.0
        self.drawn_of = 0  # keyframes in the buffer when they were drawn last

    async def draw(self) -> None:
        """Ask the node for pictures; who asks meanwhile shares the answer."""
        answer = await asyncio.wrap_future(self._watch.keyframes())
        if answer.success:
            keyframes = list(enumerate(answer.response.keyframes))
            address = {k: self._pictures.put(f"keyframe {k}{self._watch.name}", bytes(tile.data)) for k, tile in keyframes}
            self.content = f'<div class="tiles">{"".join(words.tile_html(tile, address[k]) for k, tile in keyframes)}</div>'
            drawn, ms = len(keyframes), 1000 * answer.response.cpu
            self.note = f"{drawn} keyframe{'s' * (drawn != 1)}, drawn in {ms:.0f} ms of the node's CPU time"
        else:
            self.note = answer.message
        self.at = time.time()

    def is_due(self, keyframes: int) -> bool:
        """Whether to draw without being asked: there are twice as many in the buffer as when that was said last."""
        if 0 < keyframes < 2 * self.drawn_of:
            return False
        self.drawn_of = keyframes
        return keyframes > 0


class PairView:
    """A pair of a running node: its status, services, last hour, pictures."""

    def __init__(self, watch: Watch, gallery: Gallery, pictures: Pictures) -> None:
        self._watch, self._gallery, self._pictures = watch, gallery, pictures
        self._window, self._reference, self._moment = 3600, "first", time.time()
        self._from = self._to = self._moment  # what the strip shows
        self._overlay_number, self._gallery_shown, self._charts_due = -1, -1.0, 0.0
        self._events_shown: list[Event] | None = None
        if time.time() - gallery.at > FORGOTTEN_S:
            gallery.drawn_of = 0

    def build(self) -> None:
        """Everything; once a second it is brought up to date as long as the browser is there."""
        with _part("", whole=True).props("role=status aria-live=polite"):
            with ui.row().classes("items-center gap-3"):
                self._badge = ui.label().classes("badge")
                self._usable = ui.label().classes("font-medium")
            self._words, self._reason, self._advice = ui.label(), ui.label().classes("soft text-sm"), ui.label()
            self._numbers = _html()
        with _part("", whole=True):
            self._build_actions()
        with _part("", whole=True):
            self._build_timeline()
        with _part(""):
            with ui.row().classes("w-full items-center justify-between"):
                ui.html("<h2>Overlay</h2>", sanitize=False)
                self._switch = ui.switch("live", value=True).props("dense")
            waits = "waits for a picture: one comes with the next pair of image and cloud"
            self._overlay_note = ui.label(waits).classes("soft text-sm")
            self._picture = ui.element("img").classes("w-full rounded").props('alt="points and edges over the image"')
            self._picture.set_visibility(False)
        with _part("Events"):
            self._events = _html().classes("events").props('tabindex=0 role=log aria-label="events"')
        with _part("", whole=True):
            with ui.row().classes("w-full items-center justify-between"):
                ui.html("<h2>Keyframes: edges of the image, and those of the scan in colours of their depth</h2>", sanitize=False)
                ui.button("Draw", icon="refresh", on_click=self._gallery.draw).props("flat dense no-caps").tooltip("key g")
            self._gallery_note = ui.label().classes("soft text-sm")
            self._tiles = _html()
        self.keys: dict[str, Callable[[], object]] = {
            "Escape": self._watch.stop,
            "o": lambda: self._switch.set_value(not self._switch.value),
            "g": partial(ui.timer, 0, self._gallery.draw, once=True),
            **{action.key: partial(self._ask, action) for action in ACTIONS},
            **{str(k + 1): partial(self._windows.set_value, window) for k, window in enumerate(WINDOWS)},
        }

    def _build_actions(self) -> None:
        self._buttons: dict[str, ui.button] = {}
        with ui.row().classes("gap-2"):
            for action in ACTIONS:
                button = ui.button(action.label, icon=action.icon, on_click=partial(self._ask, action))
                self._buttons[action.service] = button.props("outline no-caps").tooltip(f"key {action.key}")
        with ui.row().classes("w-full items-center no-wrap gap-3") as self._progress:
            self._stage = ui.label().classes("soft text-sm").style("min-width: 7em")
            self._bar = ui.linear_progress(0.0, show_value=False, size="6px").classes("grow")
            ui.button("Stop", on_click=self._watch.stop).props("dense no-caps color=negative unelevated").tooltip("key Esc")
        said = ui.label("Answers of the node appear here.").classes("soft text-sm mt-1").style("white-space: pre-line")
        self._answer = said.props("aria-live=polite")
        self._asked: Action | None = None
        with ui.dialog() as dialog, ui.card():
            self._question = ui.label()
            with ui.row().classes("w-full justify-end"):
                ui.button("No", on_click=dialog.close).props("flat no-caps")
                ui.button("Yes", on_click=self._confirm).props("autofocus no-caps")
        self.dialogs = [dialog]

    def _build_timeline(self) -> None:
        with ui.row().classes("w-full items-center justify-between mb-2"):
            ui.html("<h2>Timeline</h2>", sanitize=False)
            with ui.row().classes("gap-2 items-center"):
                ui.label("relative to").classes("soft text-sm")
                toggle = ui.toggle(REFERENCES, value=self._reference, on_change=lambda e: self._choose(reference=e.value))
                self._references = toggle.props('dense no-caps aria-label="relative to"')
                self._moment_input = ui.input(value=words.clock(self._moment), on_change=self._choose_moment).props(
                    'type=time step=1 dense outlined aria-label="time of the extrinsic that the charts are relative to"'
                )
                self._moment_input.bind_visibility_from(self._references, "value", lambda value: value == "moment")
                toggle = ui.toggle(WINDOWS, value=self._window, on_change=lambda e: self._choose(window=e.value))
                self._windows = toggle.props('dense no-caps aria-label="how long"')
        self._strip = ui.element("div").classes("strip").props('role=img aria-label="status over time"')
        self._strip.on("click", self._strip_clicked, js_handler=WHERE_CLICKED)
        self._strip.tooltip("a click shows the extrinsic relative to that moment")
        self._legend = _html().classes("soft text-sm my-1")
        self._charts = []
        with ui.element("div").classes("charts"):
            for name in CHARTS:
                with ui.column().classes("gap-0 w-full min-w-0"):
                    ui.html(f"<h2>{name}</h2>", sanitize=False)
                    self._charts.append(ui.echart({"series": []}).style("height: 210px; width: 100%"))

    # ---- what the browser does ----------------------------------------------------------------------------------------

    def _choose(self, window: int | None = None, reference: str | None = None) -> None:
        """Another window of time or reference, at once."""
        self._window, self._reference, self._charts_due = window or self._window, reference or self._reference, 0.0
        self.update()

    def _choose_moment(self) -> None:
        """A time of day was typed, or set by a click on the strip; one that is incomplete changes nothing."""
        moment = moment_of(str(self._moment_input.value), time.time())
        if moment is not None:
            self._moment = moment
            self._choose()

    def _strip_clicked(self, event: GenericEventArguments) -> None:
        share = event.args if isinstance(event.args, (int, float)) else 1.0
        self._references.value = "moment"
        self._moment_input.value = words.clock(self._from + min(max(float(share), 0.0), 1.0) * (self._to - self._from))

    def _ask(self, action: Action) -> None:
        """Call a service; one that changes something only after a yes."""
        self._asked = None if action.service in self._watch.busy else action
        if action.question and self._asked is not None:
            self._question.text = action.question
            self.dialogs[0].open()
        else:
            self._confirm()

    def _confirm(self) -> None:
        """Call what was asked for. What the node answers is shown to all browsers, whether this one is still there or not."""
        self.dialogs[0].close()
        if self._asked is not None:
            self._watch.call(self._asked.service)
        self._asked = None
        self.update()

    # ---- once a second ------------------------------------------------------------------------------------------------

    def update(self) -> None:
        """Bring everything up to date that has changed."""
        now, watch = time.time(), self._watch
        if watch.rig is not None:  # another page is to be shown here
            ui.navigate.reload()
            return
        if self._switch.value:
            watch.look()
        with watch.lock:
            history = watch.history
            said = words.said_of(watch, now)
            self._numbers.content = words.numbers_html(history)
            events = list(history.events)[: -EVENTS_SHOWN - 1 : -1]
            since = max(now - min(self._window, HOUR), history.started) if now - history.started > 60 else now - 60
            strip = history.strip(since, now)
            if now >= self._charts_due:
                self._charts_due = now + CHARTS_S
                newest = None if history.state is None else history.state.result.T_camera_lidar
                chosen = {"newest": newest, "moment": history.pose_at(self._moment)}  # else the first one heard
                poses, measures = history.poses(since, chosen.get(self._reference)), history.measures.rows(since, 300)
                for chart, made in zip(self._charts, words.charts(poses, measures, since, now), strict=True):
                    chart.options.clear()
                    chart.options.update(made)
                    chart.update()
        self._from, self._to = since, now
        self._badge.text, self._usable.text = said.badge, said.usable
        self._words.text, self._reason.text = said.words, said.reason
        self._advice.text = f"To do: {said.advice}" if said.advice else ""
        self._badge.style(f"background: {said.colour}")
        self._strip.style(f"background-image: {words.strip_css(strip, since, now)}")
        self._legend.content = words.legend_html(list(dict.fromkeys(status for _, _, status in strip)))
        if events != self._events_shown:
            self._events_shown = events
            self._events.content = "".join(map(words.event_html, events)) or '<p class="soft">nothing yet</p>'
        self._update_answers()
        self._update_pictures(now)

    def _update_answers(self) -> None:
        busy, answers, progress = self._watch.busy, dict(self._watch.answers), self._watch.progress
        for service, button in self._buttons.items():
            button.set_enabled(service not in busy)
            button.props(add="loading" if service in busy else "", remove="" if service in busy else "loading")
        self._progress.set_visibility(progress is not None)
        if progress is not None:
            self._stage.text, self._bar.value = progress[0] or "waits its turn", progress[1]
        if answers:
            service, (at, answer) = list(answers.items())[-1]
            found = words.words_of_check(answer.response) if service == CHECK and answer.response is not None else []
            text = f"{words.clock(at)} ~/{service} ({answer.seconds:.1f} s): {answer.message}"
            self._answer.text = "\n".join([f"{'✓' if answer.success else '✗'} {text}", *found])

    def _update_pictures(self, now: float) -> None:
        (jpeg, at, number), gallery, history = self._watch.overlay, self._gallery, self._watch.history
        if number and number != self._overlay_number:
            self._overlay_number = number
            self._picture.props(f'src="{self._pictures.put(f"overlay{self._watch.name}", jpeg)}"')
            self._picture.set_visibility(True)
        if number:
            self._overlay_note.text = f"drawn {words.ago(now - at)}; before: initial extrinsic, after: current one"
        if gallery.at != self._gallery_shown:
            self._gallery_shown, self._tiles.content = gallery.at, gallery.content
        keyframes = history.diagnosis.number("keyframes in the buffer")
        if history.heard and not history.gone and keyframes >= 0 and gallery.is_due(int(keyframes)):
            ui.timer(0, gallery.draw, once=True)
        self._gallery_note.text = gallery.note + (f", {words.ago(now - gallery.at)}" if gallery.at else "")

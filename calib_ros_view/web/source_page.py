"""The page of a source: a picture, six sliders, numbers, and what can be done; for one browser."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from nicegui import background_tasks, events, run, ui

from calib_ros.errors import CalibrationError
from calib_ros_view.session.numbers import AXES, step_of
from calib_ros_view.session.picture import COLORINGS, Look, encoded
from calib_ros_view.session.session import CHECK, MOST_TIME_OFFSET_S, REFINE, SEARCH, SEARCH_DEG, SEARCH_M, Session, SessionJobs
from calib_ros_view.web import theme
from calib_ros_view.web.panels import ZOOM, NumberPanel, ScenePanel, Sheet, Viewer
from calib_ros_view.web.server import Pictures

SLIDER_DEG, SLIDER_CM = 5.0, 60.0  # half widths; numbers beside them reach farther
KEEP = "(e) => e.stopPropagation()"  # a key of what has the focus is none of the page
THROTTLE_S = 0.03  # between two events of a slider
LOOK_ROUND_S = 2.0  # in which a page that nobody has open any more is noticed
HELD_S = 0.5  # after its last event, a slider is not set from here, so that it does not slip from under the finger
QUIET_S = 0.25  # after the last change, from which numbers are computed
TICK_S = 0.1  # between two looks at the session
FORMATS = {"tf": "TF (static_transform_publisher)", "urdf": "URDF joint", "kitti": "KITTI calib.txt", "autoware": "Autoware YAML"}
MOVES = {f"{a.keys[0]} / {a.keys[1]}": f"{a.title}: {a.more} / {a.less.removeprefix('camera ')}" for a in AXES}
HINTS = {"ArrowUp": "↑", "ArrowDown": "↓", "ArrowLeft": "←", "ArrowRight": "→"}


class SourcePage:
    """Everything that one browser sees of a session. back: address of the page that it belongs to, "" = none."""

    def __init__(self, session: Session, jobs: SessionJobs, pictures: Pictures, back: str = "") -> None:
        self._back = back
        self._session, self._jobs, self._pictures = session, jobs, pictures
        self._frame = 0
        self._seen, self._drag = -1, 0
        self._held = -1, 0.0  # slider that is moved here, and when last
        self._dirty = asyncio.Event()
        self._view = Viewer(session, lambda: self._frame, self._dirty.set)
        self._stale = {"numbers": True, "frames": True, "scene": True}
        self._changed_at = 0.0
        self._busy = False
        self._id = f"{id(self):x}"
        self._tab = "move"
        self._rows: list[tuple[ui.slider, ui.number]] = []

    def build(self) -> None:
        """Lay the page out, and keep it up to date until the browser leaves."""
        self._copied, commands = ui.dialog(), self._commands()
        keys = MOVES | {"Shift": "ten times as far"} | {key: what for key, what, _ in commands}
        keys |= {"t": "light or dark", "?": "this list"}
        keys = {_shown(key): what for key, what in keys.items()}
        with theme.bar(self._session.name, keys, self._back) as (switch, self._keys):
            self._actions()
        self._do = {key: do for _, _, dos in commands for key, do in dos.items()} | {"t": switch, "?": self._keys.open}
        with ui.element("div").classes("w-full flex flex-col lg:flex-row flex-nowrap gap-2 p-2"):
            with ui.element("div").classes("grow min-w-0 flex flex-col flex-nowrap gap-2").style("flex-basis: 0"):
                self._view.build_picture()
                with ui.element("div").classes("card p-2 flex flex-col gap-1"):
                    self._words = ui.label().classes("figures").mark("position")
                    with ui.row().classes("items-center gap-2 w-full"):
                        self._bar = ui.linear_progress(0.0, show_value=False, size="6px").classes("grow")
                        self._bar.visible = False
                    self._message = ui.label().classes("soft").mark("message")
                self._view.build_controls()
            with ui.element("div").classes("w-full shrink-0").style("flex: 0 0 min(100%, 27rem)"):
                self._panels()
        ui.keyboard(on_key=self._key, ignore=["input", "select", "textarea"])
        client = ui.context.client
        background_tasks.create(self._draw_loop(client), name="draw")
        ui.timer(TICK_S, self._tick)

    # --- parts of the page

    def _actions(self) -> None:
        theme.icon_button("chevron_left", "previous frame", lambda: self._go(-1), "p")
        theme.icon_button("chevron_right", "next frame", lambda: self._go(1), "n")
        self._frame_label = ui.label().classes("figures text-sm")
        ui.space()
        self._undo = theme.icon_button("undo", "undo", self._session.undo, "z")
        self._redo = theme.icon_button("redo", "redo", self._session.redo, "y")
        theme.icon_button("restart_alt", "back to the start", self._session.restart)
        for name, hint in ((REFINE, "Enter"), (SEARCH, "h"), (CHECK, "c")):
            with ui.button(name.capitalize(), on_click=lambda name=name: self._begin(name)).props("dense no-caps unelevated"):
                far = f" within {SEARCH_DEG:g} deg and {100 * SEARCH_M:g} cm" if name == SEARCH else ""
                ui.tooltip(f"{name} from here{far} ({hint})")
        self._stop = ui.button("Stop", on_click=self._jobs.stop).props("dense no-caps color=negative unelevated")
        with ui.button(
            "Save", on_click=lambda: self._tell(lambda: ui.notify(f"saved to {self._session.save()}", type="positive"))
        ).props("dense no-caps flat"):
            ui.tooltip(f"write {self._session.out}" if self._session.out else "no file: start with --out FILE")
        with ui.button("Copy", icon="content_copy").props("dense no-caps flat"), ui.menu():
            for form, title in FORMATS.items():
                ui.menu_item(title, on_click=lambda form=form: self._tell(partial(self._copy, form)))

    def _panels(self) -> None:
        with ui.tabs(on_change=lambda e: self._chosen(e.value)).props("dense no-caps inline-label") as tabs:
            for name, title in (("move", "Move"), ("numbers", "Numbers"), ("frames", "Frames"), ("scene", "3-D")):
                ui.tab(name, title).on("keydown.enter", js_handler=KEEP)  # it opens the tab, and refines nothing
        with ui.tab_panels(tabs, value="move", animated=False, keep_alive=True).classes("w-full card"):
            with ui.tab_panel("move").classes("p-2"):
                for k, axis in enumerate(AXES):
                    half, step = (SLIDER_DEG, 0.01) if axis.unit == "deg" else (SLIDER_CM, 0.1)
                    self._slider(axis.title, f"{_shown(axis.keys[1])} {_shown(axis.keys[0])}", half, step, axis.unit, k)
                    with ui.row().classes("w-full justify-between text-xs soft no-wrap"):
                        ui.label(f"← {axis.less.removeprefix('camera ')}")
                        ui.label(f"{axis.more.removeprefix('camera ')} →").classes("text-right")
                if any(frame.twist is not None for frame in self._session.frames):
                    ui.separator()
                    self._slider("time offset", "", 1000 * MOST_TIME_OFFSET_S, 1.0, "ms", 6)
                    ui.label("positive: points are measured later than they are stamped").classes("text-xs soft")
            with ui.tab_panel("numbers").classes("p-2"):
                self._numbers = NumberPanel(self._session)
            with ui.tab_panel("frames").classes("p-2"):
                self._sheet = Sheet(self._session, self._pictures, self._id, self._go_to, self._leave)
            with ui.tab_panel("scene").classes("p-0"):
                self._scene = ScenePanel(self._session)

    def _slider(self, title: str, keys: str, half: float, step: float, unit: str, k: int) -> None:
        with ui.row().classes("w-full items-center gap-2 no-wrap"):
            with ui.row().classes("items-baseline gap-1 no-wrap").style("flex: 0 0 7rem"):
                ui.label(title).style("white-space: nowrap")
                for key in keys.split():
                    ui.html(f"<kbd>{key}</kbd>", sanitize=False)
            slider = ui.slider(min=-half, max=half, step=step, value=0).classes("grow").props(f'aria-label="{title}"').mark(title)
            number = ui.number(value=0, step=step, suffix=unit, format="%.2f").props("dense borderless input-class=text-right")
            number.classes("figures plain").style("flex: 0 0 6.2rem").props(f'aria-label="{title}, {unit}"')
        slider.on("update:model-value", lambda e: self._slid(k, e.args), throttle=THROTTLE_S)
        slider.on("change", lambda: setattr(self, "_drag", self._drag + 1))
        number.on("change", lambda: self._slid(k, number.value), [])
        self._rows.append((slider, number))

    # --- what people do

    def _tell(self, do: Callable[[], object]) -> None:
        """Do it, or say why not."""
        try:
            do()
        except CalibrationError as error:
            ui.notify(str(error), type="warning")
            self._seen = -1  # fields show again what holds

    def _key(self, event: events.KeyEventArguments) -> None:
        key = theme.pressed(event, self._keys, self._copied)
        step = step_of(key, event.modifiers.shift)
        if step is not None:
            values = self._session.offsets
            values[step[0]] += step[1]
            self._tell(lambda: self._session.move_to(values, f"key {step[0]} {self._id}"))
            self._dirty.set()
            return
        do = self._do.get(key if key in ("Enter", "Escape") else key.lower())
        if do is not None and not (event.action.repeat and key not in ("n", "p")):
            do()

    def _commands(self) -> list[tuple[str, str, dict[str, Callable[[], object]]]]:
        """Keys and what they do, in words and indeed."""
        view, session = self._view, self._session
        near, far = partial(view.zoom, ZOOM), partial(view.zoom, 1 / ZOOM)
        out: dict[str, Callable[[], object]] = {"x": lambda: self._leave(self._frame, self._frame not in session.state.left_out)}
        return [
            ("n / p", "next / previous frame", {"n": partial(self._go, 1), "p": partial(self._go, -1)}),
            ("x", "leave this frame out, or take it back in", out),
            ("z / y", "undo / redo", {"z": session.undo, "y": session.redo}),
            ("Enter", "refine from here", {"Enter": partial(self._begin, REFINE)}),
            ("h", "search around here", {"h": partial(self._begin, SEARCH)}),
            ("c", "check", {"c": partial(self._begin, CHECK)}),
            ("Escape", "stop what runs; the keys belong to the picture again", {"Escape": self._jobs.stop}),
            ("+ / - / 0", "zoom in / out / all of the image", {"+": near, "=": near, "-": far, "0": view.show_all}),
            (
                *("i / j / k / l", "look further up / left / down / right, when zoomed in"),
                {key: partial(view.pan, *to) for key, to in zip("ijkl", ((0, -1), (-1, 0), (0, 1), (1, 0)), strict=True)},
            ),
            (
                *("1 to 5", "colour by depth, reflectivity, ring, class, edge kind"),
                {str(k + 1): partial(view.color_by, name) for k, name in enumerate(COLORINGS)},
            ),
            ("b", "now, side by side, blended with before", {"b": view.compare_next}),
            ("g", "LiDAR edges on or off", {"g": lambda: view.edges.set_value(not view.edges.value)}),
        ]

    def _leave(self, frame: int, left: bool) -> None:
        self._tell(lambda: self._session.leave_out(frame, left))

    def _slid(self, k: int, value: object) -> None:
        if not isinstance(value, int | float):
            return
        drag = f"slider {k} {self._id} {self._drag}"
        self._held = k, time.monotonic()
        self._dirty.set()  # at once, not at the next tick
        if k == 6:
            self._tell(lambda: self._session.set_time_offset(float(value) / 1000.0, drag))
            return
        values = self._session.offsets
        values[k] = float(value)
        self._tell(lambda: self._session.move_to(values, drag))

    def _go(self, by: int) -> None:
        self._go_to((self._frame + by) % len(self._session.frames))

    def _go_to(self, frame: int) -> None:
        self._frame = frame
        self._stale |= {"scene": True, "numbers": True}
        self._dirty.set()

    def _begin(self, name: str) -> None:
        self._tell(lambda: self._jobs.start(name))

    def _copy(self, form: str) -> None:
        text = self._session.export(form)
        ui.clipboard.write(text)
        self._copied.clear()
        with self._copied, ui.card().classes("card"):
            ui.label(f"{FORMATS[form]}: copied").classes("font-semibold")
            ui.code(text).classes("w-full").style("max-width: 85vw")
            ui.button("Close", on_click=self._copied.close).props("flat dense no-caps")
        self._copied.open()

    def _chosen(self, tab: str) -> None:
        self._tab = tab
        self._changed_at = 0.0

    # --- what the page does by itself

    async def _draw_loop(self, client: Any) -> None:
        """Draw the newest state whenever something has changed; what comes meanwhile is drawn together."""
        while not client.is_deleted:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._dirty.wait(), LOOK_ROUND_S)
            if not self._dirty.is_set():
                continue
            self._dirty.clear()
            state, frame, look = self._session.state, self._frame, self._view.look
            try:
                data = await run.io_bound(self._rendered, frame, state, look)
            except Exception as error:  # a picture that silently stands still would be worse
                with client:
                    ui.notify(str(error) or type(error).__name__, type="warning")
                    # No later picture could be drawn either, unless another colouring was chosen meanwhile.
                    if isinstance(error, CalibrationError) and self._view.look.coloring == look.coloring != COLORINGS[0]:
                        self._view.color_by(COLORINGS[0])
                continue
            if data is None or client.is_deleted:
                continue
            with client:
                self._view.image.set_source(self._pictures.put(self._id, data))
        self._pictures.drop(self._id)

    def _rendered(self, frame: int, state: Any, look: Look) -> bytes:
        picture = self._session.picture_by(frame, look.coloring)
        return encoded(picture.draw(self._session.shown_at(frame, state), self._session.start, look))

    async def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        if self._seen != self._session.version:
            self._seen = self._session.version
            self._changed_at = loop.time()
            self._stale = dict.fromkeys(self._stale, True)
            self._show_position()
            self._dirty.set()
        self._show_job()
        if not self._busy and self._stale.get(self._tab, False) and loop.time() - self._changed_at > QUIET_S:
            self._busy, self._stale[self._tab] = True, False  # the part that is looked at
            parts = {"numbers": self._numbers.show, "frames": self._sheet.show, "scene": self._scene.show}
            try:
                await parts[self._tab](self._session.state, self._frame, self._view.look)
            except CalibrationError as error:
                ui.notify(str(error), type="warning")
            finally:
                self._busy = False

    def _show_position(self) -> None:
        state, values = self._session.state, self._session.offsets
        for k, (slider, number) in enumerate(self._rows):
            value = float(values[k]) if k < 6 else 1000 * state.time_offset_s
            if k != self._held[0] or time.monotonic() - self._held[1] > HELD_S:
                slider.value = value
            number.value = round(value, 3)
        rotation, shift = float(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:]))
        self._words.text = f"{state.what}: {rotation:.2f} deg and {shift:.1f} cm from the start"
        for button, can in zip((self._undo, self._redo), self._session.can_step, strict=True):
            button.set_enabled(can)

    def _show_job(self) -> None:
        name = self._session.frames[self._frame].name
        out = ", left out" if self._frame in self._session.state.left_out else ""
        self._frame_label.text = f"{self._frame + 1}/{len(self._session.frames)} {name[-12:]}{out}"
        job = self._jobs.current
        self._stop.visible = self._bar.visible = job is not None and job.running
        if job is None:
            self._message.text = "move the cloud onto the image with the keys or the sliders, then refine; ? lists the keys"
            return
        self._bar.value = job.share
        now = f"{job.stage} {100 * job.share:.0f} %" if job.running else job.message
        self._message.text = f"{job.title(self._session.state)}: {now}"
        self._numbers.show_check(job)


def _shown(key: str) -> str:
    for name, hint in HINTS.items():
        key = key.replace(name, hint)
    return key

"""The picture of the page of a source, zoom, and how it is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from nicegui import events, ui

from calib_ros_view.session.picture import BACKGROUNDS, COLORINGS, COMPARISONS, EDGE_KIND, KIND_COLORS, KIND_NAMES, Look
from calib_ros_view.session.session import Session
from calib_ros_view.web import theme

WIDEST, LARGE = 1920, 1600  # px of the picture, and from where points of 2 px are too small to see
ZOOM, LEAST_WINDOW = 1.6, 0.02  # per step, and the smallest part of the image
PAN = 0.25  # per step, of the part that is shown
# Where the wheel turned, as shares of the picture, and which way.
WHEEL = "(e) => emit(e.offsetX / e.target.clientWidth, e.offsetY / e.target.clientHeight, e.deltaY)"


class Viewer:
    """Picture and controls of one browser.

    frame: index of the one that is shown. on_change: called when the picture is to be drawn anew.
    """

    def __init__(self, session: Session, frame: Callable[[], int], on_change: Callable[[], None]) -> None:
        self._session, self._frame, self._on_change = session, frame, on_change
        self._look = Look(size=2 if session.camera.width < LARGE else 3)
        self._selects: dict[str, ui.select] = {}

    @property
    def look(self) -> Look:
        """How the picture is drawn now, at its size."""
        return replace(self._look, width=min(self._session.camera.width, WIDEST))

    def build_picture(self) -> None:
        """Lay out the picture, which zooms by the wheel and is moved by a click."""
        with ui.element("div").classes("card overflow-hidden stays"):
            self._image = ui.interactive_image(on_mouse=self._mouse, events=["mousedown"], cross=False).classes("w-full")
            self._image.on("wheel.prevent", self._wheel, js_handler=WHEEL, throttle=0.05, trailing_events=False)

    def build_controls(self) -> None:
        """Lay out how the picture is drawn."""
        with (
            ui.element("div")
            .classes("card p-2 grid gap-x-4 gap-y-1")
            .style("grid-template-columns: repeat(auto-fill, minmax(11rem, 1fr)); align-content: start; align-items: center")
        ):
            self._choice("points by", COLORINGS, "coloring")
            self._choice("image", BACKGROUNDS, "background")
            self._choice("compare with the start", COMPARISONS, "comparison")
            self._slider("point size", "size", 1, 9, 1)
            self._slider("opacity", "opacity", 0.1, 1, 0.05)
            self._slider("points from, m", "near", 0, 30, 0.5)
            self._slider("points up to, m", "far", 31, 200, 1)
            with ui.row().classes("items-center gap-2"):
                ui.checkbox("cloud", value=True, on_change=lambda e: self._set(cloud=e.value)).props("dense")
                self._edges = ui.checkbox("edges", value=False, on_change=lambda e: self._set(edges=e.value)).props("dense")
            with ui.row().classes("items-center gap-1 no-wrap"):
                theme.icon_button("zoom_in", "zoom in", lambda: self.zoom(ZOOM), "+")
                theme.icon_button("zoom_out", "zoom out", lambda: self.zoom(1 / ZOOM), "-")
                theme.icon_button("fit_screen", "all of the image", self.show_all, "0")
            self._legend = ui.row().classes("gap-3 text-xs").style("grid-column: 1 / -1")
            self._legend.visible = False
            with self._legend:
                for kind, (b, g, r) in KIND_COLORS.items():
                    with ui.row().classes("items-center gap-1"):
                        ui.element("span").style(f"width: .7em; height: .7em; border-radius: 50%; background: rgb({r},{g},{b})")
                        ui.label(KIND_NAMES[kind]).classes("soft")

    def show(self, source: str) -> None:
        """Show the picture at an address."""
        self._image.set_source(source)

    # --- what keys do

    def color_by(self, coloring: str) -> None:
        """Colour the points by one of COLORINGS."""
        self._selects["coloring"].set_value(coloring)

    def compare_next(self) -> None:
        """The next of COMPARISONS."""
        now = COMPARISONS.index(self._look.comparison)
        self._selects["comparison"].set_value(COMPARISONS[(now + 1) % len(COMPARISONS)])

    def switch_edges(self) -> None:
        """Show the LiDAR edges, or hide them."""
        self._edges.set_value(not self._edges.value)

    def zoom(self, factor: float, at: tuple[float, float] = (0.5, 0.5)) -> None:
        """Zoom in by a factor, about a place in shares of the picture."""
        left, top, right, bottom = self._look.window
        width = float(np.clip((right - left) / factor, LEAST_WINDOW, 1.0))
        height = float(np.clip((bottom - top) / factor, LEAST_WINDOW, 1.0))
        x, y = left + at[0] * (right - left), top + at[1] * (bottom - top)
        self._cut(x - at[0] * width, y - at[1] * height, width, height)

    def pan(self, right: float, down: float) -> None:
        """Show what lies beside the part that is shown, by so many PAN of its size."""
        left, top, end, bottom = self._look.window
        width, height = end - left, bottom - top
        self._cut(left + PAN * right * width, top + PAN * down * height, width, height)

    def show_all(self) -> None:
        """All of the image."""
        self._set(window=Look().window)

    # --- parts

    def _choice(self, label: str, options: tuple[str, ...], name: str) -> None:
        select = ui.select(list(options), value=getattr(self._look, name), label=label).props("dense outlined")
        select.on_value_change(lambda e: self._set(**{name: e.value}))
        self._selects[name] = select

    def _slider(self, label: str, name: str, low: float, high: float, step: float) -> None:
        with ui.column().classes("gap-0"):
            ui.label(label).classes("text-xs soft")
            slider = ui.slider(min=low, max=high, step=step, value=getattr(self._look, name))
            slider.props(f'aria-label="{label}" dense label')
            slider.on("update:model-value", lambda e: self._set(**{name: e.args}), throttle=0.1)

    def _set(self, **values: Any) -> None:
        self._look = replace(self._look, **values)
        self._legend.visible = self._look.edges or self._look.coloring == EDGE_KIND
        self._on_change()

    def _cut(self, left: float, top: float, width: float, height: float) -> None:
        """Show a part of the image, moved to lie within it; all in shares of it."""
        left, top = float(np.clip(left, 0, 1 - width)), float(np.clip(top, 0, 1 - height))
        self._set(window=(left, top, min(left + width, 1.0), min(top + height, 1.0)))

    def _wheel(self, event: events.GenericEventArguments) -> None:
        x, y, delta = event.args
        self.zoom(ZOOM if delta < 0 else 1 / ZOOM, (x, y))

    def _mouse(self, event: events.MouseEventArguments) -> None:
        """A click takes the place to the middle of the picture."""
        left, top, right, bottom = self._look.window
        width, height = right - left, bottom - top
        if width >= 1:
            return
        size = self._session.picture(self._frame()).size(self.look)
        x, y = left + event.image_x / size[0] * width, top + event.image_y / size[1] * height
        self._cut(x - width / 2, y - height / 2, width, height)

"""What is computed when the extrinsic rests, and only while it is looked at: numbers, the contact sheet of all frames, and the
cloud in three dimensions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np
from nicegui import run, ui

from calib_ros import se3
from calib_ros.view.colored_cloud import colored_cloud
from calib_ros.view.jobs import Job
from calib_ros.view.picture import Look, encoded
from calib_ros.view.plots import curve_plots, ellipse_plots, frame_bars
from calib_ros.view.session import Session, State
from calib_ros.web.pictures import Pictures

THUMB_WIDTH = 360  # px
FRUSTUM = ((-0.5, -0.3), (0.5, -0.3), (0.5, 0.3), (-0.5, 0.3))  # of the camera in the scene, m at a distance of 1 m
POINT_SIZE = 0.06  # m
EYE, AIM = (-12.0, 6.0, 6.0), (10.0, 0.0, 0.0)  # m, LiDAR frame


class Panel(Protocol):
    """A part of the page that is brought up to date when it is looked at."""

    async def show(self, state: State, frame: int, look: Look) -> None:
        """Show a state and a frame. CalibrationError if it cannot be shown."""
        ...


class NumberPanel:
    """Scores and their curves, what the scenes know, and the verdict of the check."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._score = ui.label().classes("figures").mark("score")
        self._error = ui.label().classes("figures soft").mark("error")
        self._bars = ui.html("", sanitize=False).classes("w-full")
        ui.label("score of each frame, and over each axis around here (all on one scale)").classes("text-xs soft")
        self._curves = ui.html("", sanitize=False).classes("w-full grid grid-cols-2 gap-1")
        ui.label("where the scenes put the extrinsic from here, with 95 %").classes("text-xs soft pt-2")
        self._ellipses = ui.html("", sanitize=False).classes("w-full grid grid-cols-3 gap-1")
        self._known = ui.label().classes("text-sm figures").style("white-space: pre-line")
        self._verdict = ui.label().classes("text-sm").style("white-space: pre-line").mark("verdict")

    async def show(self, state: State, frame: int, look: Look) -> None:
        """Compute and show them. TooFewFeaturesError if too few points are in view."""
        scores = self._session.scores
        numbers = await run.io_bound(scores.at, state.T, state.left_out, state.time_offset_s)
        if numbers is None:  # the server ends
            return
        self._score.text = f"score {numbers.score:.4f}"
        self._bars.set_content(frame_bars(numbers.frame_scores, frame))
        self._curves.set_content(curve_plots(numbers))
        error = self._session.error()
        self._error.text = "" if error is None else f"{error[0]:.3f} deg and {100 * error[1]:.2f} cm from the source's reference"
        known = await run.io_bound(scores.known, state.T, state.left_out, state.time_offset_s)
        if known is None:
            return
        self._ellipses.set_content(ellipse_plots(known))
        hidden = [f"not shown by these scenes: {direction}" for direction in known.unobservable]
        self._known.text = "\n".join([*known.words(), *hidden])

    def show_check(self, job: Job) -> None:
        """The verdict of a check."""
        if job.check is not None:
            axes = "\n".join(f"{axis.name}  {axis.verdict.value}  {axis.words}" for axis in job.check.axes)
            self._verdict.text = f"check: {job.check.verdict.value}\n{axes}"


class Sheet:
    """All frames, small; a click shows one, a box leaves it out. go: shows a frame. leave_out: of a frame, or back in."""

    def __init__(
        self, session: Session, pictures: Pictures, owner: str, go: Callable[[int], None], leave_out: Callable[[int, bool], None]
    ) -> None:
        self._session, self._pictures, self._owner = session, pictures, owner
        self._cells: list[tuple[ui.image, ui.checkbox, ui.label]] = []
        with ui.element("div").classes("grid gap-2").style("grid-template-columns: repeat(auto-fill, minmax(11rem, 1fr))"):
            for k in range(len(session.frames)):
                self._cells.append(self._cell(k, go, leave_out))

    def _cell(
        self, k: int, go: Callable[[int], None], leave_out: Callable[[int, bool], None]
    ) -> tuple[ui.image, ui.checkbox, ui.label]:
        with ui.element("div"):
            picture = ui.image().classes("w-full cursor-pointer rounded").style("min-height: 3rem")
            picture.props(f'tabindex=0 alt="frame {k + 1}"')
            picture.on("click", lambda: go(k))
            with ui.row().classes("items-center justify-between no-wrap"):
                box = ui.checkbox(f"{k + 1}", value=True).props("dense")
                box.on("update:model-value", lambda event: leave_out(k, not event.args))
                label = ui.label().classes("text-xs figures soft")
        return picture, box, label

    async def show(self, state: State, frame: int, look: Look) -> None:
        """Draw all frames, and their scores."""
        own = replace(look, width=THUMB_WIDTH, window=Look().window, size=1, comparison="now")
        numbers = await run.io_bound(self._session.scores.at, state.T, (), state.time_offset_s)
        for k, (picture, box, label) in enumerate(self._cells):
            data = await run.io_bound(self._drawn, k, state, own)
            if data is None or numbers is None:
                return
            picture.set_source(self._pictures.put(f"{self._owner}-{k}", data))
            box.value = k not in state.left_out
            value = numbers.frame_scores[k]
            label.text = f"{value:.3f}" if np.isfinite(value) else "no score"

    def _drawn(self, frame: int, state: State, look: Look) -> bytes:
        return encoded(self._session.picture(frame).draw(self._session.shown_at(frame, state), None, look))


class ScenePanel:
    """The cloud in the colours of the image, with the camera; made when it is looked at first."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._scene: ui.scene | None = None
        self._place = ui.element("div").classes("w-full")
        ui.label("drag to turn, right button or two fingers to pan, wheel to come near").classes("text-xs soft p-2")

    async def show(self, state: State, frame: int, look: Look) -> None:
        """Colour the cloud of a frame."""
        T = self._session.shown_at(frame, state)
        cloud = await run.io_bound(colored_cloud, self._session.frames[frame], T)
        if cloud is None:
            return
        if self._scene is None:
            with self._place:
                self._scene = ui.scene(grid=False, background_color="#181a1d").classes("w-full").style("height: 26rem")
            self._scene.move_camera(*EYE, *AIM, 0, 0, 1, duration=0)
        self._scene.clear()
        with self._scene:
            self._scene.point_cloud(cloud.xyz.tolist(), (cloud.rgb / 255.0).tolist(), point_size=POINT_SIZE)
            centre = se3.inverse(T)[:3, 3]
            for u, v in FRUSTUM:
                corner = se3.transform(se3.inverse(T), np.array([[u, v, 1.0]]))[0]
                self._scene.line(centre.tolist(), corner.tolist()).material("#fb923c")

"""Parts of the pages: the picture of a source with its controls, and what is computed when the extrinsic rests and only while it
is looked at: numbers, the contact sheet of all frames, clouds in three dimensions."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from html import escape
from typing import Any

import numpy as np
from nicegui import events, run, ui
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.errors import CalibrationError
from calib_ros_check.rig.shown import RigShown
from calib_ros_check.tolerance import TITLES
from calib_ros_view.session.numbers import curve_plots, ellipse_plots, frame_bars
from calib_ros_view.session.picture import (
    BACKGROUNDS,
    COLORINGS,
    COMPARISONS,
    EDGE_KIND,
    KINDS,
    MOST_POINTS,
    Look,
    colored_cloud,
    encoded,
)
from calib_ros_view.session.session import Session, SessionJob, SessionState
from calib_ros_view.web import theme
from calib_ros_view.web.server import Pictures

THUMB_WIDTH = 360  # px
FRUSTUM = ((-0.5, -0.3), (0.5, -0.3), (0.5, 0.3), (-0.5, 0.3))  # of the camera in the scene, m at a distance of 1 m
POINT_SIZE = 0.06  # m
EYE, AIM = (-6.0, -6.0, -12.0), (0.0, 0.0, 10.0)  # m, camera frame: what is looked at, and from where at first
GAMMA = 2.2  # of the colours of pictures
RISE_DEG = (-80.0, 80.0)  # of the eye above what is looked at
RIG_EYE, RIG_AIM = (-9.0, -7.0, 9.0), (2.0, 0.0, 0.0)  # m, of a rig in the frame of its reference
UPRIGHT = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # a camera as reference: z up in the scene
CLOUD_COLORS = ("#56b4e9", "#e69f00", "#f0e442", "#cc79a7")  # of LiDARs, on the dark ground; apart for all colour vision
FRUSTUM_M, FRUSTUM_COLOR = 1.2, "#ffffff"  # how far cameras of a rig are drawn
REDRAWN_S = 5.0  # between two drawings of moving clouds: half a megabyte goes over the wire
# How the view is moved by buttons: turn about the vertical and upwards, deg; pan to the right, and distance, times the distance.
STEPS = (
    ("rotate_left", "turn to the left", (-15.0, 0.0), 0.0, 1.0),
    ("rotate_right", "turn to the right", (15.0, 0.0), 0.0, 1.0),
    ("arrow_upward", "from higher", (0.0, 10.0), 0.0, 1.0),
    ("arrow_downward", "from lower", (0.0, -10.0), 0.0, 1.0),
    ("west", "pan to the left", (0.0, 0.0), -0.15, 1.0),
    ("east", "pan to the right", (0.0, 0.0), 0.15, 1.0),
    ("zoom_in", "come near", (0.0, 0.0), 0.0, 0.75),
    ("zoom_out", "go away", (0.0, 0.0), 0.0, 1.33),
)
WIDEST, LARGE = 1920, 1600  # px of the picture, and from where points of 2 px are too small to see
ZOOM, LEAST_WINDOW = 1.6, 0.02  # per step, and the smallest part of the image
PAN = 0.25  # per step, of the part that is shown
# Where the wheel turned, as shares of the picture, and which way.
WHEEL = "(e) => emit(e.offsetX / e.target.clientWidth, e.offsetY / e.target.clientHeight, e.deltaY)"


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

    async def show(self, state: SessionState, frame: int, look: Look) -> None:
        """Compute and show them. TooFewFeaturesError if too few points are in view."""
        scores = self._session.scores
        numbers = await run.io_bound(scores.at, state.T, state.left_out, state.time_offset_s)
        if numbers is None:  # the server ends
            return
        self._score.text = f"score {numbers.score:.4f}"
        self._bars.set_content(frame_bars(numbers.frame_scores, frame))
        self._curves.set_content(curve_plots(numbers))
        if (reference := self._session.reference) is not None:
            deg, m = se3.error(reference, state.T)
            self._error.text = f"{deg:.3f} deg and {100 * m:.2f} cm from the source's reference"
        known = await run.io_bound(scores.known, state.T, state.left_out, state.time_offset_s)
        if known is None:
            return
        self._ellipses.set_content(ellipse_plots(known))
        hidden = [f"not shown by these scenes: {direction}" for direction in known.unobservable]
        self._known.text = "\n".join([*known.words(), *hidden])

    def show_check(self, job: SessionJob) -> None:
        """The verdict of a check."""
        if job.check is not None:
            axes = "\n".join(f"{TITLES[axis.name]}: {axis.verdict.value}, {axis.words}" for axis in job.check.axes)
            self._verdict.text = f"{job.title(self._session.state)}: {job.check.verdict.value}\n{axes}"


class Sheet:
    """All frames, small; a click shows one, a box leaves it out. go: shows a frame. leave_out: of a frame, or back in."""

    def __init__(
        self, session: Session, pictures: Pictures, owner: str, go: Callable[[int], None], leave_out: Callable[[int, bool], None]
    ) -> None:
        self._session, self._pictures, self._owner = session, pictures, owner
        with ui.element("div").classes("w-full grid gap-2").style("grid-template-columns: repeat(auto-fill, minmax(10rem, 1fr))"):
            self._cells = [self._cell(k, go, leave_out) for k in range(len(session.frames))]

    def _cell(
        self, k: int, go: Callable[[int], None], leave_out: Callable[[int, bool], None]
    ) -> tuple[ui.image, ui.checkbox, ui.label]:
        def choose(left: bool) -> None:
            leave_out(k, left)
            box.value = k not in self._session.state.left_out  # the last frame stays in

        with ui.element("div"):
            picture = ui.image().classes("w-full cursor-pointer rounded").style("min-height: 3rem")
            picture.props(f'tabindex=0 alt="frame {k + 1}"')
            picture.on("click", lambda: go(k))
            picture.on("keydown.enter.stop", lambda: go(k), [])
            with ui.row().classes("items-center justify-between no-wrap"):
                box = ui.checkbox(f"{k + 1}", value=True).props("dense")
                box.on("update:model-value", lambda event: choose(not event.args))
                label = ui.label().classes("text-xs figures soft")
        return picture, box, label

    async def show(self, state: SessionState, frame: int, look: Look) -> None:
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

    def _drawn(self, frame: int, state: SessionState, look: Look) -> bytes:
        try:
            picture = self._session.picture_by(frame, look.coloring)
        except CalibrationError:  # the large picture says what this frame lacks
            picture, look = self._session.picture(frame), replace(look, coloring=COLORINGS[0])
        return encoded(picture.draw(self._session.shown_at(frame, state), None, look))


class TurnedScene:
    """A scene in three dimensions that is turned by mouse, fingers or buttons; made when it is looked at first."""

    def __init__(self, height: str = "26rem") -> None:
        self._height = height
        self._scene: ui.scene | None = None
        self._aim = np.zeros(3)
        self._place = ui.element("div").classes("w-full")
        with ui.row().classes("items-center gap-0 px-2"):
            for icon, hint, turn, pan, factor in STEPS:
                theme.icon_button(icon, hint, partial(self._step, turn, pan, factor))
        ui.label("or drag to turn, right button or two fingers to pan, wheel to come near").classes("text-xs soft p-2")

    def _opened(self, eye: Matrix, aim: Matrix) -> ui.scene:
        """The scene, empty; at first seen from `eye` (3,)."""
        if self._scene is None:
            with self._place:
                self._scene = ui.scene(grid=False, background_color="#181a1d").classes("w-full").style(f"height: {self._height}")
            self._aim = aim
            self._look(eye, 0.0)
        self._scene.clear()
        return self._scene

    def _frustum(self, T: Matrix, corners: Matrix, color: str) -> None:
        """A camera at T_scene_camera (4, 4) that sees as far as corners (4, 3), m; inside of the scene."""
        assert self._scene is not None
        centre, ends = T[:3, 3].tolist(), se3.transform(T, corners).tolist()
        for k, end in enumerate(ends):
            self._scene.line(centre, end).material(color)
            if len(ends) == 4:
                self._scene.line(end, ends[k - 1]).material(color)

    async def _step(self, turn: tuple[float, float], pan: float, factor: float) -> None:
        """Turn about what is looked at, from wherever the mouse has taken the view; or look at what is beside it."""
        if self._scene is None:
            return
        at = (await self._scene.get_camera())["position"]
        arm = np.array([at["x"], at["y"], at["z"]]) - self._aim
        far, rise = float(np.linalg.norm(arm)), float(np.arctan2(arm[2], np.hypot(arm[0], arm[1])))
        around = float(np.arctan2(arm[1], arm[0])) + np.deg2rad(turn[0])
        rise = float(np.clip(rise + np.deg2rad(turn[1]), *np.deg2rad(RISE_DEG)))
        self._aim = self._aim + pan * far * np.array([-np.sin(around), np.cos(around), 0.0])
        arm = factor * far * np.array([np.cos(rise) * np.cos(around), np.cos(rise) * np.sin(around), np.sin(rise)])
        self._look(self._aim + arm, 0.2)

    def _look(self, eye: Matrix, seconds: float) -> None:
        assert self._scene is not None
        (x, y, z), (u, v, w) = eye.tolist(), self._aim.tolist()
        self._scene.move_camera(x, y, z, u, v, w, 0, 0, 1, duration=seconds)


class ScenePanel(TurnedScene):
    """The cloud in the colours of the image, with the camera."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self._session = session

    async def show(self, state: SessionState, frame: int, look: Look) -> None:
        """Colour the cloud of a frame."""
        T = self._session.shown_at(frame, state)
        cloud = await run.io_bound(colored_cloud, self._session.frames[frame], T)
        if cloud is None:
            return
        xyz, rgb, _ = cloud
        # From behind the camera, whichever way it looks: not all LiDARs call that x.
        scene = self._opened(*se3.transform(se3.inverse(T), np.array([EYE, AIM])))
        linear = (rgb / 255.0) ** GAMMA  # as the scene wants colours; those of pictures would look pale
        with scene:
            scene.point_cloud(_rounded(xyz), _rounded(linear), point_size=POINT_SIZE)
            self._frustum(se3.inverse(T), np.array([[u, v, 1.0] for u, v in FRUSTUM]), "#fb923c")


class RigScene(TurnedScene):
    """The clouds of all LiDARs of a rig, each in a colour of its own, with the cameras, in the frame of the reference."""

    def __init__(self) -> None:
        super().__init__("30rem")
        self._names = ui.html("", sanitize=False).classes("text-xs px-2 pb-2")
        self._drawn: list[object] = []
        self._next = 0.0

    async def show(self, rig: RigShown, clouds: Mapping[str, NDArray[np.float32]], corners: Callable[[str], Matrix]) -> None:
        """Draw them, if they are others than before. clouds: (n, 3) in the frames of LiDARs. corners: (4, 3) of a camera's
        picture at a depth of 1 m."""
        now = time.monotonic()
        drawn: list[object] = [rig.poses[name].tobytes() for name in rig.poses] + [(n, id(xyz)) for n, xyz in clouds.items()]
        if drawn == self._drawn or not clouds or now < self._next:
            return
        self._drawn, self._next = drawn, now + REDRAWN_S
        upright = UPRIGHT if rig.reference in rig.cameras else np.eye(4)
        poses = {name: upright @ T for name, T in rig.poses.items()}
        made = await run.io_bound(_colored_clouds, clouds, poses, rig.lidars)
        if made is None:
            return
        scene = self._opened(np.array(RIG_EYE), np.array(RIG_AIM))
        with scene:
            for xyz, rgb in made:
                scene.point_cloud(xyz, rgb, point_size=POINT_SIZE)
            for name in rig.cameras:
                self._frustum(poses[name], FRUSTUM_M * corners(name), FRUSTUM_COLOR)
            for name, T in poses.items():
                scene.text(name, "color: #fff; font-size: 11px; background: #0008; padding: 0 3px").move(*T[:3, 3].tolist())
        colors = ((name, CLOUD_COLORS[k % len(CLOUD_COLORS)]) for k, name in enumerate(rig.lidars) if name in clouds)
        self._names.set_content(" &nbsp; ".join(f'<span style="color: {c}">■</span> {escape(name)}' for name, c in colors))


def _colored_clouds(
    clouds: Mapping[str, NDArray[np.float32]], poses: Mapping[str, Matrix], lidars: Sequence[str]
) -> list[tuple[list[list[float]], list[list[float]]]]:
    """Points and colours of every cloud in the scene: high points are brighter, so that things stand out from the road."""
    found, most = [], MOST_POINTS // (2 * max(len(clouds), 1))
    for k, name in enumerate(lidars):
        if name in clouds and name in poses:
            kept = clouds[name][:: max(-(-len(clouds[name]) // most), 1)]
            xyz = se3.transform(poses[name], kept)
            color = np.array([int(CLOUD_COLORS[k % len(CLOUD_COLORS)][i : i + 2], 16) / 255 for i in (1, 3, 5)]) ** GAMMA
            low, high = np.quantile(xyz[:, 2], [0.05, 0.95]) if len(xyz) else (0.0, 1.0)
            bright = np.clip((xyz[:, 2] - low) / max(high - low, 1e-3), 0, 1)
            found.append((_rounded(xyz), _rounded((0.3 + 0.7 * bright[:, None]) * color)))
    return found


def _rounded(values: NDArray[np.floating]) -> list[list[float]]:
    """To a thousandth: they go over the wire as text."""
    return np.asarray(np.round(values.astype(float), 3)).tolist()  # type: ignore[no-any-return]


class Viewer:
    """Picture and controls of one browser. frame: index of the one that is shown. on_change: the picture is to be drawn anew.
    image, edges: what is shown, and whether LiDAR edges are."""

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
            self.image = ui.interactive_image(on_mouse=self._mouse, events=["mousedown"], cross=False).classes("w-full")
            turned = lambda e: self.zoom(ZOOM if e.args[2] < 0 else 1 / ZOOM, (e.args[0], e.args[1]))  # noqa: E731
            self.image.on("wheel.prevent", turned, js_handler=WHEEL, throttle=0.05, trailing_events=False)

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
                self.edges = ui.checkbox("edges", value=False, on_change=lambda e: self._set(edges=e.value)).props("dense")
            with ui.row().classes("items-center gap-1 no-wrap"):
                theme.icon_button("zoom_in", "zoom in", lambda: self.zoom(ZOOM), "+")
                theme.icon_button("zoom_out", "zoom out", lambda: self.zoom(1 / ZOOM), "-")
                theme.icon_button("fit_screen", "all of the image", self.show_all, "0")
            self._legend = ui.row().classes("gap-3 text-xs").style("grid-column: 1 / -1")
            self._legend.visible = False
            with self._legend:
                for (b, g, r), name in KINDS.values():
                    with ui.row().classes("items-center gap-1"):
                        ui.element("span").style(f"width: .7em; height: .7em; border-radius: 50%; background: rgb({r},{g},{b})")
                        ui.label(name).classes("soft")

    # --- what keys do

    def color_by(self, coloring: str) -> None:
        """Colour the points by one of COLORINGS."""
        self._selects["coloring"].set_value(coloring)

    def compare_next(self) -> None:
        """The next of COMPARISONS."""
        now = COMPARISONS.index(self._look.comparison)
        self._selects["comparison"].set_value(COMPARISONS[(now + 1) % len(COMPARISONS)])

    def zoom(self, factor: float, at: tuple[float, float] = (0.5, 0.5)) -> None:
        """Zoom in by a factor, about a place in shares of the picture."""
        left, top, right, bottom = self._look.window
        width, height = (float(np.clip(own / factor, LEAST_WINDOW, 1.0)) for own in (right - left, bottom - top))
        x, y = left + at[0] * (right - left - width), top + at[1] * (bottom - top - height)
        self._look = replace(self._look, window=(0.0, 0.0, width, height))
        self.pan(x / width / PAN, y / height / PAN)  # which keeps it within the image

    def pan(self, right: float, down: float) -> None:
        """Show what lies beside the part that is shown, by so many PAN of its size."""
        left, top, end, bottom = self._look.window
        width, height = end - left, bottom - top
        left, top = np.clip(left + PAN * right * width, 0, 1 - width), np.clip(top + PAN * down * height, 0, 1 - height)
        self._set(window=(float(left), float(top), min(float(left) + width, 1.0), min(float(top) + height, 1.0)))

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

    def _mouse(self, event: events.MouseEventArguments) -> None:
        """A click takes the place to the middle of the picture."""
        if self._look.window != Look().window:
            width, height = self._session.picture(self._frame()).size(self.look)
            self.pan((event.image_x / width - 0.5) / PAN, (event.image_y / height - 0.5) / PAN)

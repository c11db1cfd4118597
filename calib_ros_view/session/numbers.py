"""The numbers beside a picture, and their plots: the six that move an extrinsic, scores around it, frame by frame, and what the
scenes know of it.

All of it is of the edges alone, which are extracted once per frame; an extrinsic that is moved by hand costs a few ten thousand
projections, not new edges.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.covariance import Direction, covariance, open_directions
from calib_ros.registration.features import FrameFeatures, at_time_offset, usable_frames
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits
from calib_ros.registration.search.optimizers import LEVELS, TOLERANCE_DEG, refined

STEP_DEG, STEP_CM, LARGE = 0.05, 1.0, 10  # of a key, and with shift so many times as far
CURVE_DEG, CURVE_M, SAMPLES = 2.0, 0.3, 41  # half widths of the curves, and scores along each
POINTS = 40_000  # edge points that tell a curve; more take longer and change nothing
REACH = np.array([np.deg2rad(2.0)] * 3 + [0.3] * 3)  # rad, m; how far the optimum is sought: what a hand has left
UNKNOWN_DEG, UNKNOWN_M = 0.5, 0.1  # standard deviations from which a direction counts as not shown, as the tolerances of a check
ELLIPSE_POINTS = 64
PROBABILITY = 0.95  # inside an ellipse
# Axes of the twist that compensate each other, and are looked at together: a rotation moves points as a shift does.
PAIRS = ((1, 3), (0, 4), (2, 5))
WIDTH, HEIGHT, MARGIN = 200, 96, 16  # px of one plot
BAR_WIDTH, BARS = 300, 46  # px of the bars of all frames
SIDE = 140  # px of an ellipse's plot
LEAST_DEG, LEAST_CM = 0.1, 1.0  # half widths of an ellipse's plot, at least
AROUND = 1.25  # of the ellipse and the cross
FLAT = 1e-12


@dataclass(frozen=True)
class Axis:
    """One of the six numbers.

    more, less: what a larger and a smaller one mean, for people. keys: that make it larger and smaller; arrows move the points in
    the picture. unit: deg or cm.
    """

    name: str
    title: str
    more: str
    less: str
    keys: tuple[str, str]
    unit: str


AXES = (
    Axis("rx", "pitch", "camera looks further down", "camera looks further up", ("ArrowUp", "ArrowDown"), "deg"),
    Axis("ry", "yaw", "camera looks further left", "camera looks further right", ("ArrowRight", "ArrowLeft"), "deg"),
    Axis("rz", "roll", "camera is rolled anticlockwise", "camera is rolled clockwise", ("e", "q"), "deg"),
    Axis("tx", "sideways", "camera further left", "camera further right", ("a", "d"), "cm"),
    Axis("ty", "height", "camera further up", "camera further down", ("r", "f"), "cm"),
    Axis("tz", "forward", "camera further back", "camera further forward", ("s", "w"), "cm"),
)


def moved(start: Matrix, values: Matrix) -> Matrix:
    """The start (4, 4) moved by (6,) deg and cm: the LiDAR is shifted along the camera's axes, then all turns about the camera.

    So a rotation leaves the camera where it is, as one turns a camera on its mount. Inverse of `offsets`.
    """
    R = Rotation.from_rotvec(np.deg2rad(values[:3])).as_matrix()
    return se3.from_parts(R @ start[:3, :3], R @ (start[:3, 3] + np.asarray(values[3:]) / 100.0))


def offsets(start: Matrix, T: Matrix) -> Matrix:
    """The numbers (6,), deg and cm, that move the start (4, 4) to T (4, 4)."""
    R = T[:3, :3] @ start[:3, :3].T
    shift = R.T @ T[:3, 3] - start[:3, 3]
    return np.concatenate([np.rad2deg(Rotation.from_matrix(R).as_rotvec()), 100.0 * shift])


def step_of(key: str, shift: bool) -> tuple[int, float] | None:
    """Number of the axis that a key moves, and by how much, deg or cm; None if it moves nothing."""
    for k, axis in enumerate(AXES):
        for sign, own in zip((1, -1), axis.keys, strict=True):
            if own in (key, key.lower()):  # shift makes letters capital
                return k, sign * (STEP_DEG if axis.unit == "deg" else STEP_CM) * (LARGE if shift else 1)
    return None


@dataclass(frozen=True, eq=False)
class Numbers:
    """Scores at an extrinsic.

    score: of all frames together. offsets: (6, n) along each axis of a left twist, deg and cm; curves: (6, n) scores there, the
    other axes at rest. frame_scores: (frames,), NaN for a frame that is left out or has no points in view.
    """

    score: float
    offsets: Matrix
    curves: Matrix
    frame_scores: Matrix


@dataclass(frozen=True, eq=False)
class Known:
    """What the scenes know near an extrinsic.

    T: (4, 4), the optimum of the score within reach. offset: (6,) the left twist that leads there, rad and m. covariance: (6, 6)
    of the optimum, rad and m. unobservable: the directions that the scenes hardly show.
    """

    T: Matrix
    offset: Matrix
    covariance: Matrix
    unobservable: tuple[Direction, ...]

    def words(self) -> list[str]:
        """A line per axis: where the optimum lies from here, and within what (two standard deviations)."""
        lines = []
        for axis, value, sigma in zip(AXES, self.offset, np.sqrt(np.diag(self.covariance)), strict=True):
            scale = 180 / np.pi if axis.unit == "deg" else 100.0
            lines.append(f"{axis.title} {scale * value:+.2f} {axis.unit} (±{2 * scale * sigma:.2f} {axis.unit})")
        return lines


class FrameScores:
    """Scores of the frames of one source, with the edges that they are made of.

    frames: of one camera. One that cannot be used keeps its place, without a score. progress: of the features; it may raise.
    Raises BadInputError if there are no frames, or none of them can be used.
    """

    def __init__(
        self, frames: Sequence[Frame], camera: Camera, config: Config | None = None, progress: Progress = SILENT
    ) -> None:
        if not frames:
            raise BadInputError("no frames given; give at least one")
        self.calibrator = Calibrator(camera, config)
        used, self.notes = usable_frames(frames, self.calibrator.extract, None, progress)
        if not used:
            raise BadInputError(f"no frame can be used: {'; '.join(self.notes)}")
        self.features: tuple[FrameFeatures, ...] = tuple(features for _, features in used)
        places = {id(frame): k for k, frame in enumerate(frames)}
        self._place = np.array([places[id(frame)] for frame, _ in used])
        self._count = len(frames)
        self._atlas: Atlas | None = None
        self._lock = threading.Lock()  # samples are valid until the next call

    def features_of(self, frame: int) -> FrameFeatures | None:
        """The features of the frame at a position; None if it cannot be used."""
        found = np.flatnonzero(self._place == frame)
        return self.features[int(found[0])] if len(found) else None

    def at(self, T: Matrix, left_out: Collection[int] = (), time_offset_s: float = 0.0) -> Numbers:
        """The scores at T (4, 4), all points taken as measured `time_offset_s` later. left_out: positions of frames that do not
        count. TooFewFeaturesError if too few points are in view."""
        with self._lock:
            score = self._score(T, left_out, time_offset_s)
            part = score.subset(POINTS, np.random.default_rng(0))
            finest = score.n_levels - 1
            unit = np.linspace(-1, 1, SAMPLES)
            half = np.repeat([np.deg2rad(CURVE_DEG), CURVE_M], 3)
            twists = (unit[None, :, None] * (half[:, None] * np.eye(6))[:, None, :]).reshape(-1, 6)
            values = part.values(se3.exp_many(twists) @ T, finest).reshape(6, SAMPLES)
            offsets = np.repeat([CURVE_DEG, 100 * CURVE_M], 3)[:, None] * unit
            frame_scores = np.full(self._count, np.nan)
            frame_scores[self._place] = score.frame_scores(T)
            return Numbers(score.at(-1).value(T), offsets, values, frame_scores)

    def known(self, T: Matrix, left_out: Collection[int] = (), time_offset_s: float = 0.0) -> Known:
        """The optimum near T (4, 4), and how well it is known. Arguments and errors as of `at`."""
        with self._lock:
            score = self._score(T, left_out, time_offset_s)
            found, _ = refined(score, T, Limits(T, REACH), LEVELS, TOLERANCE_DEG)
            C = covariance(score, found)
            unobservable = tuple(open_directions(C, UNKNOWN_DEG, UNKNOWN_M))
            return Known(found, se3.log(found @ se3.inverse(T)), C, unobservable)

    def _score(self, T: Matrix, left_out: Collection[int], time_offset_s: float) -> PointScore:
        features = [at_time_offset(own, time_offset_s) for own in self.features] if time_offset_s else self.features
        score = self.calibrator.objectives(features, T, T, atlas=self._atlas).edges.score
        self._atlas = score.atlas
        kept = ~np.isin(self._place[score.frame], list(left_out))
        if not kept.any():
            raise TooFewFeaturesError("all frames are left out, or show nothing here; take one back in")
        return score if kept.all() else score.select(kept)


def ellipse(covariance: Matrix, pair: tuple[int, int]) -> Matrix:
    """The ellipse in which two axes of a twist lie with PROBABILITY, (n, 2), deg and cm, about the origin. covariance: (6, 6)."""
    scale = np.where(np.array(pair) < 3, 180 / np.pi, 100.0)
    C = covariance[np.ix_(pair, pair)] * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(C)
    turn = np.linspace(0, 2 * np.pi, ELLIPSE_POINTS)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.asarray(circle * np.sqrt(chdtri(2, 1 - PROBABILITY) * np.maximum(values, 0)) @ vectors.T)


def curve_plots(numbers: Numbers) -> str:
    """Six curves of the score, each about the present extrinsic in the middle, with a mark at its highest place."""
    low, high, made = float(numbers.curves.min()), float(numbers.curves.max()), []
    span = max(high - low, FLAT)
    for axis, x, y in zip(AXES, numbers.offsets, numbers.curves, strict=True):
        u = MARGIN + (x - x[0]) / (x[-1] - x[0]) * (WIDTH - 2 * MARGIN)
        v = HEIGHT - MARGIN - (y - low) / span * (HEIGHT - 2.2 * MARGIN)
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(u, v, strict=True))
        peak, middle = int(np.argmax(y)), WIDTH / 2
        made.append(
            f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="score over {axis.title}, highest at '
            f'{x[peak]:+.2f} {axis.unit}"><line class="now" x1="{middle}" x2="{middle}" y1="{MARGIN}" y2="{HEIGHT - MARGIN}" '
            f'stroke-dasharray="3 3"/><polyline class="curve" points="{points}"/>'
            f'<circle cx="{u[peak]:.1f}" cy="{v[peak]:.1f}" r="3" fill="var(--accent)"/>'
            f'<text x="{MARGIN}" y="11">{axis.title}</text><text x="{WIDTH - MARGIN}" y="11" '
            f'text-anchor="end">best {x[peak]:+.2f} {axis.unit}</text><text x="{MARGIN}" y="{HEIGHT - 3}">{x[0]:g}</text>'
            f'<text x="{WIDTH - MARGIN}" y="{HEIGHT - 3}" text-anchor="end">{x[-1]:+g} {axis.unit}</text></svg>'
        )
    return "".join(made)


def ellipse_plots(known: Known) -> str:
    """Where the scenes put the extrinsic from here, with 95 %, for the pairs of axes that compensate each other."""
    made = []
    for pair in PAIRS:
        scale = np.array([180 / np.pi if k < 3 else 100.0 for k in pair])
        centre = known.offset[list(pair)] * scale
        border = ellipse(known.covariance, pair) + centre
        least = np.array([LEAST_DEG if k < 3 else LEAST_CM for k in pair])
        half = np.maximum(AROUND * np.abs(border).max(axis=0), least)
        at = SIDE / 2 + border / half * (SIDE / 2 - MARGIN) * [1, -1]
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in at)
        one, other = (AXES[k] for k in pair)
        middle = SIDE / 2
        made.append(
            f'<svg class="plot" viewBox="0 0 {SIDE} {SIDE}" role="img" aria-label="{one.title} and {other.title} with 95 %">'
            f'<line class="now" x1="{middle}" x2="{middle}" y1="{MARGIN}" y2="{SIDE - MARGIN}" stroke-dasharray="3 3"/>'
            f'<line class="now" y1="{middle}" y2="{middle}" x1="{MARGIN}" x2="{SIDE - MARGIN}" stroke-dasharray="3 3"/>'
            f'<polygon class="curve" points="{points}"/><text x="{middle}" y="{SIDE - 2}" text-anchor="middle">{one.title} '
            f'±{half[0]:.2g} {one.unit}</text><text x="{middle}" y="10" text-anchor="middle">{other.title} ±{half[1]:.2g} '
            f"{other.unit}</text></svg>"
        )
    return "".join(made)


def frame_bars(scores: Matrix, shown: int) -> str:
    """A bar per frame with its score, up from a line at 0 or down from it; a frame without a score has none."""
    values = np.nan_to_num(np.asarray(scores, float), nan=0.0)
    low, high = min(float(values.min(initial=0.0)), 0.0), max(float(values.max(initial=0.0)), 0.0)
    per_score, step = (BARS - 2) / max(high - low, FLAT), BAR_WIDTH / max(len(values), 1)
    zero = 1 + high * per_score
    bars = []
    for k, value in enumerate(values):
        style = "var(--mark)" if k == shown else "var(--accent)"
        top, height = zero - max(value, 0) * per_score, abs(value) * per_score
        bars.append(
            f'<rect x="{k * step + 1:.1f}" y="{top:.1f}" width="{max(step - 2, 1):.1f}" height="{height:.1f}" fill="{style}">'
            f"<title>frame {k + 1}: {value:.3f}</title></rect>"
        )
    line = f'<line x1="0" x2="{BAR_WIDTH}" y1="{zero:.1f}" y2="{zero:.1f}" stroke="currentColor" stroke-width=".6"/>'
    label = 'role="img" aria-label="score of each frame"'
    return f'<svg class="plot" viewBox="0 0 {BAR_WIDTH} {BARS}" {label}>{"".join(bars)}{line}</svg>'

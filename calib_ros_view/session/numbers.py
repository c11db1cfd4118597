"""The numbers beside a picture: scores around an extrinsic, frame by frame, and what the scenes know of it.

All of it is of the edges alone, which are extracted once per frame; an extrinsic that is moved by hand costs a few ten thousand
projections, not new edges.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.covariance import Direction, covariance, unobservable_directions
from calib_ros.registration.features import FrameFeatures, at_time_offset
from calib_ros.registration.frames import usable_frames
from calib_ros.registration.nuisance.parameters import LEVELS, TOLERANCE_DEG, refined
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits
from calib_ros_view.session.motion import AXES

CURVE_DEG, CURVE_M, SAMPLES = 2.0, 0.3, 41  # half widths of the curves, and scores along each
POINTS = 40_000  # edge points that tell a curve; more take longer and change nothing
REACH = np.array([np.deg2rad(2.0)] * 3 + [0.3] * 3)  # rad, m; how far the optimum is sought: what a hand has left
UNKNOWN_DEG, UNKNOWN_M = 0.5, 0.1  # standard deviations from which a direction counts as not shown, as the tolerances of a check
ELLIPSE_POINTS = 64
PROBABILITY = 0.95  # inside an ellipse
# Axes of the twist that compensate each other, and are looked at together: a rotation moves points as a shift does.
PAIRS = ((1, 3), (0, 4), (2, 5))


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
            unobservable = tuple(unobservable_directions(C, UNKNOWN_DEG, UNKNOWN_M))
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
    return np.asarray(circle * np.sqrt(chi2.ppf(PROBABILITY, 2) * np.maximum(values, 0)) @ vectors.T)

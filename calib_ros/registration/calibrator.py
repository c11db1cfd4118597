"""The method: extract features, search, refine, say how sure it is."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.features import FeatureExtractor, Features
from calib_ros.registration.frame_features import FrameFeatures
from calib_ros.registration.objectives import FastObjective, Objective, ThesisObjective
from calib_ros.registration.plausibility import MIN_SCORE, distinctness
from calib_ros.registration.point_score import PointScore
from calib_ros.registration.search import SearchBox
from calib_ros.registration.thesis_features import ThesisFeatures
from calib_ros.registration.uncertainty import covariance
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, Result

Matrix = NDArray[np.float64]
Progress = Callable[[str, float], None]


class Calibrator:
    """Estimates T_camera_lidar from frames of one camera.

    camera: the intrinsics that the frames were taken with. config: all constants.
    """

    def __init__(self, camera: Camera, config: Config | None = None) -> None:
        self.config = config or Config()
        self.extract = FeatureExtractor(camera, self.config)

    def calibrate(
        self, frames: Sequence[Frame], initial: ArrayLike, search: SearchBox | None = None, progress: Progress | None = None
    ) -> Result:
        """One-shot or multi-frame estimate.

        frames: at least one. initial: T_camera_lidar (4, 4) to start from. search: box around it; None = refine only.
        progress: called with a stage's name and 0..1. A frame whose scan is empty is left out and named in the reason.
        Raises BadInputError for frames of different calibrations and for an initial that is no rigid transform.
        """
        started = time.perf_counter()
        T0 = se3.as_transform(initial, "the initial extrinsic")
        if not frames:
            raise BadInputError("no frames given; give at least one")
        _same_reference(frames)
        features, left_out = [], []
        for k, frame in enumerate(frames):
            try:
                features.append(self.extract(frame))
            except TooFewFeaturesError as error:
                left_out.append(f"frame {frame.name or k} left out: {error}")
            if progress:
                progress("features", (k + 1) / len(frames))
        return self.estimate(features, T0, search, progress, started, "; ".join(left_out))

    def estimate(
        self,
        features: Sequence[Features],
        initial: Matrix,
        box: SearchBox | None = None,
        progress: Progress | None = None,
        started: float | None = None,
        note: str = "",
    ) -> Result:
        """The same from features. A failure is a Result with a status and a reason; its transform is the initial one."""
        started = time.perf_counter() if started is None else started
        notes = [note] if note else []
        try:
            result = self._estimate(features, initial, box, progress or (lambda stage, share: None), notes)
        except TooFewFeaturesError as error:
            reason = "; ".join([str(error), *notes])
            result = Result(initial, INSUFFICIENT, reason, frames_used=len(features), initial=initial)
        return replace(result, elapsed_s=time.perf_counter() - started)

    def _estimate(
        self, features: Sequence[Features], initial: Matrix, box: SearchBox | None, report: Progress, notes: list[str]
    ) -> Result:
        """Raises TooFewFeaturesError if at any extrinsic on the way too little falls into the image."""
        objective = self._objective(features, initial)
        T, searching = initial, box is not None and not box.is_empty
        if box is not None and searching:
            T = objective.search(initial, box, report)
        T = objective.climb(T, searching, report)
        value, before = objective.value(T), objective.value(initial)
        if value < before:
            T, value = _or_stay(objective, T, value, initial, report)
        problem = self._problem(T, value, initial, before, box) or self._chance(objective.match(), T)
        problem = problem or objective.doubt(T, report)
        if not all(f.has_reflectivity for f in features):
            notes.append("the cloud has no intensity: reflectivity edges are off")
        if len(features) == 1:
            notes.append(
                "one frame only: directions that it does not show may be wrong, and nothing tells how much; use more scenes"
            )
        return Result(
            initial if problem else T,
            REFUSED if problem else CONVERGED,
            "; ".join([problem, *notes] if problem else notes),
            value,
            None if problem else covariance(objective.smooth(T), T, floor=objective.floor),
            len(features),
            initial_score=before,
            initial=initial,
            frame_scores=tuple(float(s) for s in objective.frame_scores(T)),
        )

    def _objective(self, features: Sequence[Features], T_prior: Matrix) -> Objective:
        """The configured objective; it fits the features, since the same configuration extracted them."""
        if self.config.refine.objective == "thesis":
            return ThesisObjective([f for f in features if isinstance(f, ThesisFeatures)], T_prior, self.config)
        return FastObjective([f for f in features if isinstance(f, FrameFeatures)], T_prior, self.config)

    def _problem(self, T: Matrix, value: float, initial: Matrix, before: float, box: SearchBox | None) -> str:
        """Why the estimate is not to be used; empty if it is. A result worse than its start is never converged."""
        config = self.config.refine
        if value < before:
            return f"no better extrinsic found: score {value:.3f} against {before:.3f} at the start"
        move_deg, move_m = se3.rotation_error_deg(initial, T), se3.translation_error_m(initial, T)
        limit_deg, limit_m = config.max_rotation_deg, config.max_translation_m
        if box is not None and not box.is_empty:  # corners of the box are sqrt(3) half widths away
            limit_deg = max(limit_deg, 2 * box.rotation_deg)
            limit_m = max(limit_m, 2 * box.translation_m)
        if move_deg > limit_deg or move_m > limit_m:
            return (
                f"the optimum is {move_deg:.1f} deg / {move_m:.2f} m away from the start, "
                f"beyond {limit_deg:g} deg / {limit_m:g} m; widen the search"
            )
        return ""

    def _chance(self, score: PointScore, T: Matrix) -> str:
        """The same for an optimum that is no better than chance finds in pictures as rich in edges."""
        value = score.at(-1).value(T)
        if not value >= MIN_SCORE:
            return (
                f"score {value:.2f} is below {MIN_SCORE:g}: the image shows nothing where the LiDAR sees edges; "
                "check exposure, lens, topics and time stamps"
            )
        found, needed = distinctness(score, T), self.config.refine.min_distinctness
        if found >= needed:
            return ""
        return (
            f"the optimum stands out {found:.1f}-fold from its surroundings, {needed:g}-fold is needed: LiDAR and image do not "
            "match here; use more scenes, widen the search, or check intrinsics, topics and time stamps"
        )


def _or_stay(objective: Objective, T: Matrix, value: float, initial: Matrix, report: Progress) -> tuple[Matrix, float]:
    """The optimum right at the initial extrinsic instead of T, if it scores no less.

    The coarse levels lead a start that is already right a hair away, and with few frames to another optimum at times: 9 of
    25 runs of 5 consecutive KITTI frames from the true extrinsic ended on one that scores less than the start.
    """
    stay = objective.stay(initial, report)
    stay_value = objective.value(stay)
    return (stay, stay_value) if stay_value >= value else (T, value)


def _same_reference(frames: Sequence[Frame]) -> None:
    """Frames that carry references must agree: two vehicles' frames have no common extrinsic."""
    references = [(f.name, f.reference) for f in frames if f.reference is not None]
    for name, reference in references[1:]:
        if not np.allclose(reference, references[0][1], atol=1e-6):
            raise BadInputError(
                f"frames {references[0][0]} and {name} carry different calibrations and cannot be estimated together; "
                "give only frames of one recording"
            )

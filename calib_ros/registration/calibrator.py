"""The method: extract features, search, refine, say how sure it is."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import BadInputError, BadTimesError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.constraints import SEMANTIC_BOX, PoseConstraints, SearchBox, pose_constraints
from calib_ros.registration.covariance import covariance, fused, unobservable_directions
from calib_ros.registration.features import FeatureExtractor, Features
from calib_ros.registration.initial_guess import SEMANTIC, nominal
from calib_ros.registration.objective import FastObjective, Objective
from calib_ros.registration.outliers import penalised_score, prefer_start, reject_outlier_frames
from calib_ros.registration.registry import objective_kind
from calib_ros.registration.score import Atlas
from calib_ros.registration.semantic_init.guess import chosen, first_guess
from calib_ros.registration.semantic_init.view import ClassView
from calib_ros.registration.validation import (
    NullDistribution,
    chance,
    is_borderline,
    objection,
    peak_ratio_factor,
    required_peak_ratio,
    semantic_consistency_score,
)
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, Result
from calib_ros.semantics.segmentation import Segmentation

Matrix = NDArray[np.float64]
Progress = Callable[[str, float], None]
UNOBSERVABLE_DEG, UNOBSERVABLE_M = 1.0, 0.3  # a direction that is known less well (standard deviation) is not shown by the scenes


class Calibrator:
    """Estimates T_camera_lidar from frames of one camera.

    camera: the intrinsics that the frames were taken with. config: all constants. segmentation: the models of
    ``config.semantics`` where they are loaded already.
    """

    def __init__(self, camera: Camera, config: Config | None = None, segmentation: Segmentation | None = None) -> None:
        self.config = config or Config()
        self.extract = FeatureExtractor(camera, self.config)
        self.segmentation = segmentation or Segmentation(self.config.semantics)
        self._atlas: Atlas | None = None  # of the last estimate, for the next one to fill
        self.objective_factory: Callable[..., FastObjective] = (
            FastObjective  # or one that is watched: same arguments, same results
        )

    def calibrate(
        self,
        frames: Sequence[Frame],
        initial: ArrayLike | Literal["semantic"],
        search: SearchBox | None = None,
        progress: Progress | None = None,
    ) -> Result:
        """One-shot or multi-frame estimate.

        frames: at least one. initial: T_camera_lidar (4, 4) to start from, or "semantic": nothing is known, and the classes of
        points and pixels tell (see guess). search: box around it; None = refine only. progress: called with a stage's name and
        0..1. A frame whose scan is empty, or whose times cannot be, is left out and named in the reason.
        Raises BadInputError for frames of different calibrations and for an initial that is no rigid transform.
        """
        started = time.perf_counter()
        T0 = None if isinstance(initial, str) else se3.as_transform(initial, "the initial extrinsic")
        if T0 is None and initial != SEMANTIC:
            raise BadInputError(f"the initial extrinsic must be a 4x4 matrix, or '{SEMANTIC}', got {initial!r}")
        if not frames:
            raise BadInputError("no frames given; give at least one")
        _same_reference(frames)
        features: list[Features] = []
        notes: list[str] = []
        for k, frame in enumerate(frames):
            try:
                semantics = self.segmentation(frame) if self.segmentation.active else None
                features.append(self.extract(frame, semantics))
                notes += semantics.problems if semantics else ()
            except (TooFewFeaturesError, BadTimesError) as error:
                notes.append(f"frame {frame.name or k} left out: {error}")
            if progress:
                progress("features", (k + 1) / len(frames))
        note = "; ".join(notes)
        if T0 is None:
            return self.guess(features, search, progress, started, note)
        return self.estimate(features, T0, search, progress, started, note)

    def guess(
        self,
        features: Sequence[Features],
        box: SearchBox | None = None,
        progress: Progress | None = None,
        started: float | None = None,
        note: str = "",
    ) -> Result:
        """Estimate from nothing but the scenes: hypotheses by the classes of points and pixels, then the registration from the
        best of them (thesis 3.5). box: around each; None = SEMANTIC_BOX. A failure is a Result, its transform nominal.
        """
        started = time.perf_counter() if started is None else started
        views = self.views(features)
        try:
            hypotheses = first_guess(views, self.config.guess, self.config.search.seed)
        except TooFewFeaturesError as error:
            reason = "; ".join(filter(None, [str(error), note]))
            return Result(nominal(), INSUFFICIENT, reason, frames_used=len(features), initial=nominal())
        box = box or SEMANTIC_BOX
        result, tried = chosen(hypotheses, lambda T, own: self.estimate(features, T, own, progress, note=note), box)
        said = (
            f"first guess from the classes of {len(views)} of {len(features)} frames; registered from {tried} of its hypotheses"
        )
        reason = "; ".join(filter(None, [result.reason, said]))
        return replace(result, reason=reason, elapsed_s=time.perf_counter() - started)

    @staticmethod
    def views(features: Sequence[Features]) -> list[ClassView]:
        """The classes of those frames that have some."""
        return [f.fast.view for f in features if f.fast.view is not None]

    def estimate(
        self,
        features: Sequence[Features],
        initial: Matrix,
        box: SearchBox | None = None,
        progress: Progress | None = None,
        started: float | None = None,
        note: str = "",
        anchor: Matrix | None = None,
    ) -> Result:
        """The same from features. A failure is a Result with a status and a reason; its transform is the initial one.

        anchor: T_camera_lidar (4, 4) that the stage ``constraints`` counts from; None = initial.
        """
        started = time.perf_counter() if started is None else started
        notes = [note] if note else []
        try:
            anchor = initial if anchor is None else anchor
            result = self._estimate(features, initial, anchor, box, progress or (lambda stage, share: None), notes)
        except TooFewFeaturesError as error:
            reason = "; ".join([str(error), *notes])
            result = Result(initial, INSUFFICIENT, reason, frames_used=len(features), initial=initial)
        return replace(result, elapsed_s=time.perf_counter() - started)

    def _estimate(
        self,
        features: Sequence[Features],
        initial: Matrix,
        anchor: Matrix,
        box: SearchBox | None,
        report: Progress,
        notes: list[str],
    ) -> Result:
        """Raises TooFewFeaturesError if at any extrinsic on the way too little falls into the image."""
        constraints = pose_constraints(anchor, self.config.constraints, max(len(features), 1))
        objective = self._objective(features, initial, constraints)
        T, found = initial, None
        if box is not None and not box.is_empty:
            found = objective.search(T, box, report)
            T = found.T
        T = objective.optimise(T, found is not None, report)
        T, left_out, around = reject_outlier_frames(objective, T, report)
        start = constraints.limits.clip(initial)
        if penalised_score(objective, T) < penalised_score(objective, start):
            T, left_out, around = prefer_start(objective, T, start, report)
        T, sigma, unknown = self._shown(objective, T, start, box)
        value, before = objective.value(T), objective.value(start)
        used = len(features) - len(left_out)
        worse = penalised_score(objective, T) < penalised_score(objective, start)
        kept = [f for k, f in enumerate(features) if k not in left_out]
        factor = self._by_classes(kept, T, around)
        needed = required_peak_ratio(self.config.refine.min_peak_ratio, used) * factor
        problem = self._problem(T, value, initial, before, worse, box)
        problem = problem or chance(objective.edge_score().at(-1).value(T), around, needed, objection(factor))
        problem = problem or objective.cross_check(T, report)
        names = [f.name or str(k) for k, f in enumerate(features)]
        scores = objective.frame_scores(T)
        self._atlas = objective.edge_score().atlas
        if left_out:
            bad = ", ".join(names[k] for k in left_out)
            notes.append(
                f"left out, matching no better than chance where the others match: {bad}; wrongly paired, a covered lens, or a "
                "scene that shows nothing"
            )
        if unknown:
            notes.append(f"not shown by the scenes, and kept from the start: {', '.join(unknown)}")
        if not all(f.has_reflectivity for f in features):
            notes.append("the cloud has no intensity: reflectivity edges are off")
        if used == 1:
            notes.append("one frame only: a direction that it does not show may be wrong; use more scenes")
        return Result(
            initial if problem else T,
            REFUSED if problem else CONVERGED,
            "; ".join([problem, *notes] if problem else notes),
            value,
            None if problem else sigma,
            used,
            initial_score=before,
            initial=initial,
            frame_scores=tuple(float(s) for s in scores),
            frame_names=tuple(names),
            frames_left_out=tuple(names[k] for k in left_out),
            starts=None if found is None else (found.agreed, found.climbed),
        )

    def _shown(self, objective: Objective, T: Matrix, start: Matrix, box: SearchBox | None) -> tuple[Matrix, Matrix, list[str]]:
        """The optimum, its covariance (6, 6), and the directions that no scene shows: these are kept from the start."""
        score, constraints, held = objective.smooth_score(T), objective.constraints, np.zeros(6)
        C = covariance(score, T, systematic_error=objective.systematic_error, constraints=constraints)
        pressed = constraints.pressed(T, score.at(-1).linearise(T)[0])
        if pressed.any():
            # There the score is not at its top, and may bend anyhow: the limit tells where, the other axes are judged there.
            held = np.where(pressed, np.minimum(np.diag(C), constraints.limits.half**2), 0.0)
            constraints = replace(
                constraints, limits=replace(constraints.limits, half=np.where(pressed, 0.0, constraints.limits.half))
            )
            C = covariance(score, T, systematic_error=objective.systematic_error, constraints=constraints)
        unknown = unobservable_directions(C, UNOBSERVABLE_DEG, UNOBSERVABLE_M)
        if unknown:
            deg, m = box.reach if box is not None and not box.is_empty else (0.0, 0.0)
            limits = self.config.refine
            reach = [np.deg2rad(deg or limits.max_rotation_deg)] * 3 + [m or limits.max_translation_m] * 3
            kept, narrower = fused(T, C, start, np.diag(np.square(reach) * constraints.limits.open_axes))
            kept = objective.constraints.limits.clip(kept)  # turns and shifts together leave them by their second order
            if penalised_score(objective, kept) < penalised_score(
                objective, start
            ):  # so these are shown: the score bends otherwise farther away
                return T, C + np.diag(held), []
            T, C = kept, narrower
        return T, C + np.diag(held), unknown

    def fast_objective(self, features: Sequence[Features], T_prior: Matrix, anchor: Matrix | None = None) -> FastObjective:
        """The fast form around T_prior (4, 4), whatever the configured objective. Raises TooFewFeaturesError.

        anchor: T_camera_lidar (4, 4) that the stage ``constraints`` counts from; None = it does not count. The atlas of the last
        estimate is left to the next one: this is for another thread, and few frames.
        """
        constraints = None if anchor is None else pose_constraints(anchor, self.config.constraints, max(len(features), 1))
        # Semantics come later than the keyframe, if at all: with them, the score would tell new keyframes from older ones.
        return FastObjective([f.fast.plain or f.fast for f in features], T_prior, self.config, constraints)

    def _objective(self, features: Sequence[Features], T_prior: Matrix, constraints: PoseConstraints) -> Objective:
        """The configured objective; it fits the features, since the same configuration extracted them."""
        # Taken away while in use, so that an estimate in another thread lays out its own.
        last, self._atlas = self._atlas, None
        fast = [f.fast for f in features]
        atlas = Atlas([f.levels for f in fast], fast[0].camera, last) if fast else None
        if self.config.refine.objective == "fast":
            return self.objective_factory(fast, T_prior, self.config, constraints, atlas)
        return objective_kind(self.config.refine.objective).objective(features, T_prior, self.config, constraints, atlas)

    def _by_classes(self, features: Sequence[Features], T: Matrix, around: NullDistribution) -> float:
        """Share of the needed distinctness that has to be reached, by what classes say of T; they are asked in doubt only."""
        least = required_peak_ratio(self.config.refine.min_peak_ratio, len(features))
        if not self.config.semantics.consistency_check or not is_borderline(around.peak_ratio / max(least, 1e-9)):
            return 1.0
        return peak_ratio_factor(semantic_consistency_score(self.views(features)), T)

    def _problem(self, T: Matrix, value: float, initial: Matrix, before: float, worse: bool, box: SearchBox | None) -> str:
        """Why the estimate is not to be used; empty if it is. A result worse than its start is never converged."""
        config = self.config.refine
        if worse:
            return f"no better extrinsic found: score {value:.3f} against {before:.3f} at the start"
        move_deg, move_m = se3.rotation_error_deg(initial, T), se3.translation_error_m(initial, T)
        limit_deg, limit_m = config.max_rotation_deg, config.max_translation_m
        if box is not None and not box.is_empty:  # corners of the box are sqrt(3) half widths away
            reach_deg, reach_m = box.reach
            limit_deg, limit_m = max(limit_deg, 2 * reach_deg), max(limit_m, 2 * reach_m)
        if move_deg > limit_deg or move_m > limit_m:
            return (
                f"the optimum is {move_deg:.1f} deg / {move_m:.2f} m away from the start, "
                f"beyond {limit_deg:g} deg / {limit_m:g} m; widen the search"
            )
        return ""


def _same_reference(frames: Sequence[Frame]) -> None:
    """Frames that carry references must agree: two vehicles' frames have no common extrinsic."""
    references = [(f.name, f.reference) for f in frames if f.reference is not None]
    for name, reference in references[1:]:
        if not np.allclose(reference, references[0][1], atol=1e-6):
            raise BadInputError(
                f"frames {references[0][0]} and {name} carry different calibrations and cannot be estimated together; "
                "give only frames of one recording"
            )

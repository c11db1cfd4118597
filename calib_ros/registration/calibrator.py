"""The method: features of frames in, a Result out.

`Calibrator.estimate` is the whole of it: optimise -> reject outlier frames -> refine -> covariance and observability -> validate
-> Result. The steps up to the covariance are functions of alignment.py.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros import se3
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.acceptance.checks import Acceptance, class_views
from calib_ros.registration.acceptance.evidence import inflation
from calib_ros.registration.acceptance.refusal import (
    NO_INTENSITY,
    ONE_FRAME,
    Refusal,
    joined,
    outliers_note,
    semantic_note,
    unobservable_note,
)
from calib_ros.registration.acceptance.significance import (
    check_distance,
    check_improvement,
    leaves_doubt,
)
from calib_ros.registration.alignment import (
    Alignment,
    ObservablePose,
    observable_pose,
    refine_start,
    reject_outlier_frames,
)
from calib_ros.registration.features import FeatureExtractor, Features
from calib_ros.registration.frames import usable_frames, with_classes
from calib_ros.registration.initial_guess import GUESSES, MOTION, SEMANTIC, nominal
from calib_ros.registration.joint import optimise_jointly
from calib_ros.registration.motion_guess.registration import Guesser
from calib_ros.registration.nuisance.parameters import left_open
from calib_ros.registration.nuisance.rolling_shutter import seen_by_rows
from calib_ros.registration.nuisance.time_offset import TimeOffset
from calib_ros.registration.objective import FastObjective, Objective, penalised
from calib_ros.registration.progress import Callback, Observer, Progress
from calib_ros.registration.score.atlas import Atlas, AtlasCache
from calib_ros.registration.search.constraints import (
    REFINEMENT_DEG,
    REFINEMENT_M,
    SEMANTIC_BOX,
    PoseConstraints,
    SearchBox,
    pose_constraints,
    unlimited,
)
from calib_ros.result import CONVERGED, INSUFFICIENT, REFUSED, InitialSource, RefusalCode, Result
from calib_ros_semantics.first_guess.guess import best_registration, first_guess
from calib_ros_semantics.first_guess.view import ClassView
from calib_ros_semantics.models.segmentation import Segmentation
from calib_ros_thesis.registry import objective_kind

Matrix = NDArray[np.float64]
LEASH = 1.5  # half widths of the search box; beyond, an optimum is none of the box


class Calibrator:
    """Estimates T_camera_lidar from frames of one camera.

    Parameters
    ----------
    camera : Camera
        The intrinsics that the frames were taken with.
    config : Config, optional
        All settings.
    segmentation : Segmentation, optional
        The models of ``config.semantics``, where they are loaded already.
    observer : Observer, optional
        Watches the optimisation of every estimate and does not change it.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        segmentation: Segmentation | None = None,
        observer: Observer | None = None,
    ) -> None:
        self.config = config or Config()
        self.extract = FeatureExtractor(camera, self.config)
        self.segmentation = segmentation or Segmentation(self.config.semantics)
        self.observer = observer
        self._atlases = AtlasCache()

    def calibrate(
        self,
        frames: Sequence[Frame],
        initial: ArrayLike | Literal["semantic", "motion", "auto"],
        search: SearchBox | None = None,
        progress: Callback | None = None,
        consecutive: Sequence[Frame] = (),
    ) -> Result:
        """One-shot or multi-frame estimate.

        Parameters
        ----------
        frames : sequence of Frame
            At least one. A frame whose scan is empty, or whose times are impossible, is left out and named in the reason.
        initial : array_like, shape (4, 4), or "semantic", "motion" or "auto"
            T_camera_lidar to start from; "semantic" finds one from the classes of points and pixels (see `guess`), "motion" from
            the motion in consecutive frames (see `motion_guess`); "auto" tries motion, then classes, then the nominal extrinsic,
            until one converges.
        search : SearchBox, optional
            Box of the global search around it; None = refine only.
        progress : callable, optional
            Called with the name of a stage and the share of it that is done, 0..1.
        consecutive : sequence of Frame, optional
            For "motion" and "auto": some seconds of frames that follow each other, in the order of their stamps; by default
            `frames` themselves.

        Returns
        -------
        Result
            Converged, or the start with a reason.

        Raises
        ------
        BadInputError
            For frames of different calibrations, and for an initial that is no rigid transform.
        """
        started = time.perf_counter()
        T0 = None if isinstance(initial, str) else se3.as_transform(initial, "the initial extrinsic")
        if T0 is None and initial not in GUESSES:
            raise BadInputError(f"the initial extrinsic must be a 4x4 matrix or one of {', '.join(GUESSES)}, got {initial!r}")
        if not frames:
            raise BadInputError("no frames given; give at least one")
        _check_same_reference(frames)
        if T0 is None and initial != SEMANTIC:
            register = partial(self._registered, frames, progress)
            guesser = Guesser(register, len(frames), consecutive or frames, self.extract, search, self.segmentation.active)
            result = guesser.from_motion() if initial == MOTION else guesser.from_anything()
            return replace(result, elapsed_s=time.perf_counter() - started)
        wait = T0 is not None and self.classes_in_doubt_only
        segmentation = self.segmentation if self.segmentation.active and not wait else None
        used, notes = usable_frames(frames, self.extract, segmentation, Progress(progress, "features"))
        features = [features for _, features in used]
        if T0 is None:
            result = self.guess(features, search, progress, notes)
        elif wait:
            seen = partial(with_classes, used, self.extract, self.segmentation, T0, search, Progress(progress, "classes"))
            result = self.estimate_in_doubt(features, seen, T0, search, progress, notes)
        else:
            result = self.estimate(features, T0, search, progress, notes)
        return replace(result, elapsed_s=time.perf_counter() - started)

    def _registered(self, frames: Sequence[Frame], progress: Callback | None, initial: Any, box: SearchBox | None) -> Result:
        return self.calibrate(frames, initial, box, progress)

    def guess(
        self,
        features: Sequence[Features],
        box: SearchBox | None = None,
        progress: Callback | None = None,
        notes: Sequence[str] = (),
    ) -> Result:
        """Estimate without an initial extrinsic: hypotheses from the classes of points and pixels, then the registration from the
        best of them (thesis 3.5). box: around each; None = SEMANTIC_BOX. A failure is a Result, its transform nominal.
        """
        started = time.perf_counter()
        views = self.views(features)
        try:
            hypotheses = first_guess(views, self.config.guess, self.config.search.seed)
        except TooFewFeaturesError as error:
            return self._insufficient(error, nominal(), len(features), notes)
        result, tried = best_registration(
            hypotheses, lambda T, around: self.estimate(features, T, around, progress, notes), box or SEMANTIC_BOX
        )
        reason = joined([result.reason, semantic_note(len(views), len(features), tried)])
        return replace(result, reason=reason, elapsed_s=time.perf_counter() - started, origin=InitialSource.SEMANTIC)

    def estimate(
        self,
        features: Sequence[Features],
        initial: Matrix,
        box: SearchBox | None = None,
        progress: Callback | None = None,
        notes: Sequence[str] = (),
        anchor: Matrix | None = None,
    ) -> Result:
        """The same as `calibrate` from features. A failure is a Result with a status and a reason, whose transform is
        the initial one.

        notes: for the reason of the Result. anchor: T_camera_lidar (4, 4) that the stage ``constraints`` counts from; None =
        initial.
        """
        started, watch = time.perf_counter(), Progress(progress)
        try:
            origin = initial if anchor is None else anchor
            optimised = optimise_jointly(
                features, lambda own: self.objective(own, initial, origin, box), initial, box, self.config, watch
            )
            features, objective, search, T = optimised.features, optimised.objective, optimised.search, optimised.T
            start = objective.constraints.limits.clip(initial)
            if self.config.motion.readout_s:
                objective = self.objective(features, initial, origin, box, T)
                T = objective.optimise(T, searched=True, progress=watch)
            alignment = reject_outlier_frames(objective, T, watch)
            alignment = refine_start(objective, alignment, start, watch)
            acceptance = Acceptance(self.config, self.extract.source_camera.width, box)
            evidence = acceptance.evidence(objective, alignment, search, *self._leash(None))
            others = search.nearby if search is not None else ()
            pose = observable_pose(objective, alignment.T, start, self._reach(box), inflation(evidence.disagreement), others)
            shared, clocks = left_open(
                features,
                objective.smooth_score(pose.T),
                pose.T,
                pose.covariance,
                objective.constraints,
                self.config,
                self._offset_sigma(optimised.offset),
                None if optimised.offset is None else optimised.offset.effect,
            )
            score, initial_score = objective.value(pose.T), objective.value(start)
            is_worse = penalised(objective, pose.T) < penalised(objective, start)
            refusal = (
                check_improvement(is_worse, score, initial_score)
                or acceptance.check_sensors(features, objective, alignment, evidence, optimised)
                or check_distance(initial, alignment.T, objective.constraints.limits)
                or acceptance.check_match(features, objective, alignment, evidence)
                or acceptance.check_uncertainty(objective, pose)
                or objective.cross_check(pose.T, watch)
            )
            result = self._result(features, initial, alignment, pose, refusal, notes)
            result = replace(
                result,
                score=score,
                initial_score=initial_score,
                evidence=evidence,
                frame_scores=tuple(float(s) for s in objective.frame_scores(pose.T)),
                starts=None if search is None else (search.agreed, search.optimised),
                covariance=None if refusal else pose.covariance + shared,
                shared_covariance=None if refusal else shared,
                clock_covariance=None if refusal or clocks is None else clocks.covariance(self.config.motion.max_time_offset_s),
                clock_sigma_s=None if refusal or clocks is None else clocks.sigma(self.config.motion.max_time_offset_s),
            )
            if optimised.offset is not None and optimised.offset.observable(self.config.motion) and not refusal:
                seconds = self.config.motion.time_offset_s + optimised.seconds
                sigma, stamping = self._offset_sigma(optimised.offset), optimised.stamping
                result = replace(result, time_offset_s=seconds, time_offset_sigma_s=sigma, stamping=stamping)
            self._atlases.give_back(objective.edge_score().atlas)
        except TooFewFeaturesError as error:
            result = self._insufficient(error, initial, len(features), notes)
        return replace(result, elapsed_s=time.perf_counter() - started)

    def estimate_in_doubt(
        self,
        plain: Sequence[Features],
        classified: Callable[[], tuple[Sequence[Features], Sequence[str]]],
        initial: Matrix,
        box: SearchBox | None = None,
        progress: Callback | None = None,
        notes: Sequence[str] = (),
    ) -> Result:
        """`estimate` from features without classes, and where that leaves doubt, again from those with classes and the
        notes that come with them.

        What edges alone are sure of is not refused for want of evidence at the same place: classes halve the weight of many
        edges, and so take evidence away.
        """
        result = self.estimate(plain, initial, box, progress, notes)
        if not plain or not self.segmentation.active or not leaves_doubt(result):
            return result
        features, more = classified()
        if all(new is old for new, old in zip(features, plain, strict=True)):
            return replace(result, reason=joined([result.reason, *more]))
        again = self.estimate(features, initial, box, progress, [*notes, *more])
        if result.converged and self._lacks_evidence_at(again, result.T_camera_lidar):
            return replace(result, reason=joined([result.reason, *more]))
        return again

    def _lacks_evidence_at(self, result: Result, T: Matrix) -> bool:
        """Whether an estimate is refused for want of evidence, its optimum being T (4, 4) as exactly as one has to be known."""
        if result.refusal not in (RefusalCode.NOT_SIGNIFICANT, RefusalCode.TOO_UNCERTAIN) or result.optimum is None:
            return False
        off = se3.rotation_error_deg(T, result.optimum), se3.translation_error_m(T, result.optimum)
        return off[0] <= self.config.refine.tolerance_deg and off[1] <= self.config.refine.tolerance_m

    def fast_objective(self, features: Sequence[Features], T_prior: Matrix, anchor: Matrix | None = None) -> FastObjective:
        """The fast form around T_prior (4, 4), whatever the configured objective. Raises TooFewFeaturesError.

        anchor: T_camera_lidar (4, 4) that the stage ``constraints`` counts from; None = it does not count. The atlas of the last
        estimate is left to the next one: this is for another thread, and few frames.
        """
        constraints = pose_constraints(T_prior if anchor is None else anchor, self.config.constraints, max(len(features), 1))
        if anchor is None:
            constraints = PoseConstraints(unlimited(T_prior))
        constraints = constraints.leashed(T_prior, *self._leash(None))
        # Semantics come later than the keyframe, if at all: with them, the score would tell new keyframes from older ones.
        seen = seen_by_rows([f.fast.plain or f.fast for f in features], T_prior, self.extract.source_camera, self.config.motion)
        return FastObjective(seen, T_prior, self.config, constraints)

    def free_memory(self) -> None:
        """Free what is kept to make the next estimate faster, as much as the maps of all frames take: the next one is far
        away."""
        self._atlases.clear()

    @staticmethod
    def views(features: Sequence[Features]) -> list[ClassView]:
        """The classes of those frames that have some."""
        return class_views(features)

    @property
    def classes_in_doubt_only(self) -> bool:
        """Whether classes wait until an estimate without them leaves doubt; the thesis's objective needs them always."""
        return self.config.semantics.in_doubt_only and self.config.refine.objective == "fast"

    def objective(
        self,
        features: Sequence[Features],
        T_prior: Matrix,
        anchor: Matrix,
        box: SearchBox | None = None,
        T_rows: Matrix | None = None,
        atlas: Atlas | None = None,
    ) -> Objective:
        """The configured objective; it fits the features, since the same configuration extracted them. box: to be searched.
        T_rows: (4, 4), where points fall in the image, for a rolling shutter; None = T_prior. atlas: of these features, if there
        is one already that others may use as well."""
        constraints = pose_constraints(anchor, self.config.constraints, max(len(features), 1))
        constraints = constraints.leashed(T_prior, *self._leash(box))
        if atlas is None and features:
            atlas = self._atlases.atlas([f.fast.levels for f in features], features[0].fast.camera)
        kind = objective_kind(self.config.refine.objective)
        seen = seen_by_rows(features, T_prior if T_rows is None else T_rows, self.extract.source_camera, self.config.motion)
        return kind(seen, T_prior, self.config, constraints, atlas, self.observer)

    def _reach(self, box: SearchBox | None) -> Matrix:
        """How far (6,) from the start the extrinsic is expected along every axis, rad and m."""
        deg, m = box.reach if box is not None and not box.is_empty else (0.0, 0.0)
        return np.array([np.deg2rad(deg or REFINEMENT_DEG)] * 3 + [m or REFINEMENT_M] * 3)

    def _leash(self, box: SearchBox | None) -> tuple[float, float]:
        """How far in deg and m, per axis, an optimisation may go from the start: a refinement as far as it is meant to, a search
        somewhat out of its box."""
        deg, m = box.reach if box is not None else (0.0, 0.0)
        return max(LEASH * deg, REFINEMENT_DEG), max(LEASH * m, REFINEMENT_M)

    def _offset_sigma(self, offset: TimeOffset | None) -> float:
        """Standard deviation, s, of the clocks' offset."""
        prior = self.config.motion.time_offset_sigma_s
        if offset is None:
            return prior
        return offset.sigma_s if offset.exists(self.config.motion) else offset.sigma_if_none(prior)

    def _result(
        self,
        features: Sequence[Features],
        initial: Matrix,
        alignment: Alignment,
        pose: ObservablePose,
        refusal: Refusal | None,
        notes: Sequence[str],
    ) -> Result:
        """The Result without its scores."""
        names = [f.name or str(k) for k, f in enumerate(features)]
        outliers, used = [names[k] for k in alignment.outliers], len(features) - len(alignment.outliers)
        said = [
            str(refusal) if refusal else "",
            *notes,
            outliers_note(outliers) if outliers else "",
            unobservable_note(pose.unobservable) if pose.unobservable else "",
            "" if all(f.has_reflectivity for f in features) else NO_INTENSITY,
            ONE_FRAME if used == 1 else "",
        ]
        return Result(
            initial if refusal else pose.T,
            REFUSED if refusal else CONVERGED,
            joined(said),
            frames_used=used,
            initial=initial,
            frame_names=tuple(names),
            frames_left_out=tuple(outliers),
            refusal=refusal.code if refusal else None,
            refusal_figures=refusal.figures if refusal else {},
            optimum=pose.T if refusal else None,
            data_stamp=max(f.stamp for f in features),
        )

    @staticmethod
    def _insufficient(error: TooFewFeaturesError, initial: Matrix, frames: int, notes: Sequence[str]) -> Result:
        reason, code = joined([str(error), *notes]), RefusalCode.TOO_FEW_FEATURES
        return Result(initial, INSUFFICIENT, reason, frames_used=frames, initial=initial, refusal=code)


def _check_same_reference(frames: Sequence[Frame]) -> None:
    """Frames that carry references must agree: two vehicles' frames have no common extrinsic."""
    references = [(f.name, f.reference) for f in frames if f.reference is not None]
    for name, reference in references[1:]:
        if not np.allclose(reference, references[0][1], atol=1e-6):
            raise BadInputError(
                f"frames {references[0][0]} and {name} carry different calibrations and cannot be estimated together; "
                "give only frames of one recording"
            )

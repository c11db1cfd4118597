"""The method: features of frames in, a Result out.

`Calibrator.estimate` is the whole of it: optimise -> reject outlier frames -> refine -> covariance -> accept -> Result.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.config.sensors import REFINE
from calib_ros.datasets.recent import Recent
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.intrinsics import change_between
from calib_ros.registration.classes import ALL, Segmentation, class_models
from calib_ros.registration.classes import segmentation as models_of
from calib_ros.registration.covariance import inflation
from calib_ros.registration.estimate import (
    RATIO_CONSISTENT,
    Estimate,
    evidence_of,
    insufficient,
    leaves_doubt,
    observable_pose,
    refine_start,
    refined_with_camera,
    refusal_of,
    reject_outlier_frames,
)
from calib_ros.registration.features import (
    FeatureExtractor,
    FrameFeatures,
    ScanEdges,
    Used,
    other_objective,
    usable_frames,
    views_of,
    with_classes,
)
from calib_ros.registration.initial_guess import BY_CLASSES, CENTROIDS, GUESSES, MOTION, SEMANTIC, nominal
from calib_ros.registration.joint import JointSearch
from calib_ros.registration.judgement.hypotheses import AsTaken
from calib_ros.registration.judgement.judge import Judge, Question, is_only_off
from calib_ros.registration.judgement.lens import LensEstimate, LensUnknown, estimate_lens, lens_unknowns
from calib_ros.registration.judgement.refusal import MAYBE_RAW, SUSPECT_INTRINSICS, joined, odd_intrinsics
from calib_ros.registration.motion_guess.guess import best_registration, from_anything, from_motion
from calib_ros.registration.objective import Objective, ObjectiveMaker
from calib_ros.registration.progress import Callback, Progress
from calib_ros.registration.score.chance import UNDOUBTED_Z
from calib_ros.registration.search.constraints import SEMANTIC_BOX, SearchBox
from calib_ros.result import InitialSource, RefusalCode, Result

LACKS_EVIDENCE = (RefusalCode.NOT_SIGNIFICANT, RefusalCode.TOO_UNCERTAIN)
# Refusals where nothing matches: then something may be mixed up.
NO_MATCH = (
    *(RefusalCode.TOO_FEW_FEATURES, RefusalCode.LOW_SCORE, RefusalCode.NOT_SIGNIFICANT, RefusalCode.WRONG_TIMES),
    *(RefusalCode.WORSE_THAN_START, RefusalCode.TOO_FAR_FROM_START),
)
Classified = Callable[[], tuple[Sequence[FrameFeatures], Sequence[str]]]


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
    given : Camera, optional
        The intrinsics that were stated, where `camera` corrects them: what they leave open is then told by the joint estimate.
    scans, pictures : optional
        Edges of scans and of pictures, shared with the calibrators of other pairs, see `FeatureExtractor`.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        segmentation: Segmentation | None = None,
        given: Camera | None = None,
        scans: ScanEdges | None = None,
        pictures: Recent | None = None,
    ) -> None:
        self.config = config or Config()
        self._given = given
        self._unknowns: tuple[Camera, tuple[LensUnknown, ...]] | None = None  # of the lens, by the camera of the features
        self.extract = FeatureExtractor(camera, self.config, scans, pictures)
        self.segmentation = segmentation or models_of(self.config.semantics)
        self.objectives = ObjectiveMaker(self.config, camera)
        self.judge = Judge(self.objectives, self.config, camera)

    def calibrate(
        self,
        frames: Sequence[Frame],
        initial: ArrayLike | Literal["semantic", "centroids", "motion", "auto"],
        search: SearchBox | None = None,
        progress: Callback | None = None,
        consecutive: Sequence[Frame] = (),
    ) -> Result:
        """One-shot or multi-frame estimate.

        Parameters
        ----------
        frames : sequence of Frame
            At least one. A frame whose scan is empty, or whose times are impossible, is left out and named in the reason.
        initial : array_like, shape (4, 4), or "semantic", "centroids", "motion" or "auto"
            T_camera_lidar to start from; "semantic" and "centroids" find one from the classes of points and pixels (see `guess`),
            "motion" from consecutive frames; "auto" tries motion, classes and the nominal one, until one converges.
        search : SearchBox, optional
            Box of the global search around it; None = refine only.
        progress : callable, optional
            Called with the name of a stage and the share of it that is done, 0..1.
        consecutive : sequence of Frame, optional
            For "motion" and "auto": some seconds of frames, in the order of their stamps; by default `frames` themselves.

        Returns
        -------
        Result
            Converged, or the start with a reason.

        Raises
        ------
        BadInputError
            For frames of different calibrations, for an initial that is no rigid transform, and for camera.intrinsics: refine on
            pictures that show no intrinsics.
        """
        if self.config.camera.intrinsics != REFINE:
            return self._calibrated(frames, initial, search, progress, consecutive, explained=True)
        if self.extract.camera.is_sphere:
            raise BadInputError(
                "camera.intrinsics: refine needs pictures that show the intrinsics, and those of this lens are unrolled, where "
                "another focal length or principal point is not observable: set image.projection: pinhole, or camera.intrinsics: "
                "given"
            )
        if search is None and not isinstance(initial, str):
            search = SearchBox(0.0, 0.0)  # as None, but intrinsics are searched
        first = self._calibrated(frames, initial, search, progress, consecutive, explained=True)
        started, box = time.perf_counter(), search or SEMANTIC_BOX

        def whole(camera: Camera) -> Result:
            start = nominal() if first.initial is None else first.initial
            seen = [replace(frame, camera=camera) for frame in frames]
            own = Calibrator(camera, self.config, self.segmentation, self.extract.source_camera, self.extract.scans)
            return own._calibrated(seen, start, box, progress, ())

        result = refined_with_camera(first, self.extract.source_camera, whole)
        return replace(result, origin=first.origin, elapsed_s=first.elapsed_s + time.perf_counter() - started)

    def _calibrated(
        self,
        frames: Sequence[Frame],
        initial: ArrayLike | Literal["semantic", "centroids", "motion", "auto"],
        search: SearchBox | None,
        progress: Callback | None,
        consecutive: Sequence[Frame],
        explained: bool = False,
    ) -> Result:
        """`calibrate` by the camera as it is. explained: why nothing matches is looked for."""
        started = time.perf_counter()
        T0 = None if isinstance(initial, str) else se3.as_transform(initial, "the initial extrinsic")
        if T0 is None and initial not in GUESSES:
            raise BadInputError(f"the initial extrinsic must be a 4x4 matrix or one of {', '.join(GUESSES)}, got {initial!r}")
        if not frames:
            raise BadInputError("no frames given; give at least one")
        if T0 is None and initial not in BY_CLASSES:

            def register(start: Matrix | str, box: SearchBox | None) -> Result:
                return self._calibrated(frames, start, box, progress, ())

            given = register, len(frames), consecutive or frames, self.extract, search
            result = from_motion(*given) if initial == MOTION else from_anything(*given, self.segmentation.active)
            if explained and result.refusal in NO_MATCH and result.cause is None:
                used, notes = usable_frames(frames, self.extract, None, Progress(progress, "features"))
                result = self.explained(result, used, search or SEMANTIC_BOX, progress, notes, stated=False)
            return replace(result, elapsed_s=time.perf_counter() - started)
        wait = T0 is not None and self.classes_in_doubt_only
        segmentation = self.segmentation if self.segmentation.active and not wait else None
        around = None if T0 is None else (T0, search)
        used, notes = usable_frames(frames, self.extract, segmentation, Progress(progress, "features"), around)
        notes = [*_changed_reference(frames), *notes]
        features = [features for _, features in used]
        if T0 is None:
            result = self.guess(features, search, progress, notes, str(initial))
            if explained:
                result = self.explained(result, used, search or SEMANTIC_BOX, progress, notes, stated=False)
        else:
            seen = partial(with_classes, used, self.extract, self.segmentation, T0, search, Progress(progress, "classes"))
            result = self.estimate(features, T0, search, progress, notes)
            result = self.explained(result, used, search, progress, notes) if explained else result
            if wait:
                result = self.again_in_doubt(result, features, seen, T0, search, progress, notes)
        return replace(result, elapsed_s=time.perf_counter() - started)

    def guess(
        self,
        features: Sequence[FrameFeatures],
        box: SearchBox | None = None,
        progress: Callback | None = None,
        notes: Sequence[str] = (),
        method: str = SEMANTIC,
    ) -> Result:
        """Estimate without an initial extrinsic: the registration from the best hypotheses that the classes of points and pixels
        give (thesis 3.5), CENTROIDS without a sweep. box: around each; None = SEMANTIC_BOX. A failure is a Result, nominal."""
        started = time.perf_counter()
        views, models = views_of(features), class_models()
        try:
            if models is None:
                raise TooFewFeaturesError(self.segmentation.missing())
            hypotheses = models.first_guess(views, self.config.search.seed, method != CENTROIDS)
        except TooFewFeaturesError as error:
            return insufficient(error, nominal(), len(features), notes)
        result, tried = best_registration(
            hypotheses, lambda T, around: self.estimate(features, T, around, progress, notes), box or SEMANTIC_BOX
        )
        note = (
            f"first guess from the classes of {len(views)} of {len(features)} frames; registered from {tried} of its hypotheses"
        )
        return replace(
            result, reason=joined([result.reason, note]), elapsed_s=time.perf_counter() - started, origin=InitialSource.SEMANTIC
        )

    def estimate(
        self,
        features: Sequence[FrameFeatures],
        initial: Transform,
        box: SearchBox | None = None,
        progress: Callback | None = None,
        notes: Sequence[str] = (),
        anchor: Transform | None = None,
        near: bool = False,
    ) -> Result:
        """The same as `calibrate` from features. A failure is a Result whose transform is the initial one.

        notes: for its reason. anchor: T_camera_lidar (4, 4) that the stage ``constraints`` counts from; None = initial. near: the
        initial one is an optimum of frames before, which an objective of its own follows on its finest level alone: its coarser
        ones may lead away from it.
        """
        started, watch = time.perf_counter(), Progress(progress)
        make = partial(self.objectives, T_prior=initial, anchor=initial if anchor is None else anchor, box=box)
        try:
            # Optimise: the extrinsic, and the clocks' offset where the frames show it.
            optimised = JointSearch(make, initial, box, self.config, watch, near).optimum(features)
            objective, start = optimised.objective, optimised.objective.constraints.limits.clip(initial)
            # Reject outlier frames, and refine.
            alignment = reject_outlier_frames(objective, optimised.T, watch)
            alignment = refine_start(objective, alignment, start, watch)
            # Covariance.
            evidence = evidence_of(self.config, objective, alignment, optimised.search)
            inflated = inflation(evidence.disagreement)
            others = optimised.search.nearby if optimised.search else ()
            pose = observable_pose(objective, alignment.T, start, box, inflated, others)
            matches = evidence.p_value <= RATIO_CONSISTENT * self.config.refine.max_p_value  # else nothing is told of the lens
            asked = matches or self.config.camera.intrinsics == REFINE
            lens = self._lens(objective, alignment.T, inflated) if asked else None
            found = Estimate(initial, start, optimised, alignment, evidence, *pose, lens)
            # Accept, with what intrinsics and clocks leave open, or say why not.
            stated, searched = self.extract.source_camera, box is not None and not box.is_empty
            refusal = refusal_of(found, self.config, stated, searched, watch)
            if refusal is not None and refusal.code in SUSPECT_INTRINSICS and stated.said_rectified:
                notes = [MAYBE_RAW, *notes]
            notes = [*odd_intrinsics(stated), *notes]
            result = found.result(self.config, lens if self._given is None else None, refusal, notes)
            if self.config.camera.intrinsics == REFINE and lens is not None:
                result = replace(result, refined_camera=lens.refined_camera(stated, found.T, found.covariance))
            self.objectives.maps = objective.edges.score.atlas
        except TooFewFeaturesError as error:
            result = insufficient(error, initial, len(features), notes)
        return replace(result, elapsed_s=time.perf_counter() - started)

    def _lens(self, objective: Objective, T: Transform, inflated: float) -> LensEstimate | None:
        """What the scenes tell of the lens at an optimum (4, 4)."""
        camera, score = self.extract.source_camera, objective.edges.score
        if self._unknowns is None or self._unknowns[0] is not score.camera:
            self._unknowns = score.camera, lens_unknowns(self.config.camera, camera, score.camera)
        unknowns = self._unknowns[1]
        given = self._given or camera
        centre = np.array([-change_between(given, camera, own.name) / own.unit for own in unknowns])
        return estimate_lens(score, T, objective.constraints.limits, unknowns, inflated, centre)

    def again_in_doubt(
        self,
        result: Result,
        plain: Sequence[FrameFeatures],
        classified: Classified,
        initial: Transform,
        box: SearchBox | None = None,
        progress: Callback | None = None,
        notes: Sequence[str] = (),
    ) -> Result:
        """The result of `estimate` from features without classes, or where that leaves doubt, of those with classes and their
        notes. What edges alone are sure of is not refused for want of evidence there: classes halve the weight of many edges."""
        if not plain or not self.segmentation.active or not leaves_doubt(result):
            return result
        features, more = classified()
        if all(new is old for new, old in zip(features, plain, strict=True)):
            return replace(result, reason=joined([result.reason, *more]))
        again = self.estimate(features, initial, box, progress, [*notes, *more])
        if result.converged and again.refusal in LACKS_EVIDENCE and again.optimum is not None:
            deg, m = se3.error(result.T_camera_lidar, again.optimum)  # as exactly as the extrinsic has to be known
            if deg <= self.config.refine.tolerance_deg and m <= self.config.refine.tolerance_m:
                return replace(result, reason=joined([result.reason, *more]))
        return again

    def explained(
        self,
        result: Result,
        used: Sequence[Used] | Sequence[FrameFeatures],
        box: SearchBox | None,
        progress: Callback | None = None,
        notes: Sequence[str] = (),
        stated: bool = True,
    ) -> Result:
        """The result; where nothing matches, with its cause, if a hypothesis about what was mixed up explains the frames.

        used: with their pictures, which may be rectified anew, or features alone. box: that was searched about its start. notes:
        for its reason. stated: somebody has stated that start.
        """
        frames = [own for own in used if isinstance(own, tuple)]
        features = [own for own in used if isinstance(own, FrameFeatures)] or [own for _, own in frames]
        undoubted = result.cause is not None and (result.evidence is None or result.evidence.z_score >= UNDOUBTED_Z)
        if result.refusal not in NO_MATCH or undoubted or not features or result.initial is None:
            return result  # of clocks there is doubt where their best offset hardly matches
        refine = self.config.refine
        as_taken = self.pictures_of(frames) if frames else None
        box = None if box is None or box.is_empty else box
        stated = stated and bool(result.initial[:3, 3].any())  # a camera at the LiDAR's very place is a guess
        asked = Question(features, result.initial, box, as_taken, stated=stated, progress=Progress(progress, "causes"))
        given = self.judge.as_given(features, result.initial, [] if result.optimum is None else [result.optimum])
        found = self.judge.explain(asked, given, refine.tolerance_deg, refine.tolerance_m)
        if found is None or is_only_off(found, refine.tolerance_deg, refine.tolerance_m):
            return result
        figures = {**result.refusal_figures, "z_score_mended": found.z_score}
        cause, mended = found.hypothesis.cause, f"with that mended they match, z-score {found.z_score:.1f}"
        reason = joined([found.hypothesis.message, mended, *notes])
        return replace(result, reason=reason, cause=cause, refusal_figures=figures)

    def pictures_of(self, used: Sequence[Used]) -> AsTaken:
        """The features of frames (those with these numbers, None = all), had another camera taken them."""

        def as_taken(camera: Camera, numbers: Sequence[int] | None) -> Sequence[FrameFeatures]:
            extract = FeatureExtractor(camera, self.config)
            chosen = used if numbers is None else [used[k] for k in numbers]
            return [extract.seen_anew(own, frame.image) for frame, own in chosen]

        return as_taken

    @property
    def classes_in_doubt_only(self) -> bool:
        """Whether classes wait until an estimate without them leaves doubt."""
        return not self.kinds_without_doubt

    @property
    def kinds_without_doubt(self) -> tuple[str, ...]:
        """The kinds of models that run on every frame, whether or not estimates leave doubt: those of another objective alone,
        since its edges search and validate without classes as well."""
        other = other_objective(self.config)
        if other is not None and other.uses:
            return other.uses
        return () if self.config.semantics.in_doubt_only else ALL


def _changed_reference(frames: Sequence[Frame]) -> list[str]:
    """A note where the recording itself changes the extrinsic that it states."""
    known = [(f.name, f.reference) for f in frames if f.reference is not None]
    for name, reference in known[1:]:
        if not np.allclose(reference, known[0][1], atol=1e-6):
            deg, m = se3.rotation_error_deg(known[0][1], reference), se3.translation_error_m(known[0][1], reference)
            return [
                f"the recording states another extrinsic for frame {name} than for {known[0][0]}, {deg:.2f} deg and "
                f"{100 * m:.1f} cm apart; if the sensors were moved in between, estimate from frames before or after"
            ]
    return []

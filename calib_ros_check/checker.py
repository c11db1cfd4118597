"""The check of an extrinsic by frames of one recording.

`Checker.check_features` is the whole of it: does an optimum near the extrinsic match beyond chance? If none does, was something
mixed up, or is the extrinsic far off? Then what is left: clocks, intrinsics, and the size of the error, judged by the tolerance.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import Config, update
from calib_ros.config.registration import NO_LIMIT_DEG, NO_LIMIT_M
from calib_ros.datasets.source import spread_positions
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import Segmentation
from calib_ros.registration.covariance import covariance, disagreement, freedom, inflation, noise_of, shows_lens, shows_noise
from calib_ros.registration.features import FrameFeatures, ScanEdges, at_time_offset, usable_frames, with_classes
from calib_ros.registration.judgement.hypotheses import MIXED_UP, AsTaken, fisheyes
from calib_ros.registration.judgement.judge import NEAR, Candidate, Match, Question, convinces, is_only_off, log_odds, rare_odds
from calib_ros.registration.judgement.lens import LensEstimate
from calib_ros.registration.judgement.refusal import Refusal
from calib_ros.registration.progress import Callback, Progress
from calib_ros.registration.score.chance import UNDOUBTED_Z
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.registration.search.optimizers import NEAR_LEVELS, TOLERANCE_DEG, refined
from calib_ros.registration.search.search import FRUITLESS_ROUNDS
from calib_ros.result import CONVERGED, Cause, Evidence, RefusalCode, Result
from calib_ros_check.causes import (
    AS_GIVEN,
    OFF,
    OTHER_FITS,
    PARAMETER_PENALTY,
    clock_finding,
    complete,
    explained,
    findings,
    lens_findings,
    lens_for_mount,
    possible_causes,
)
from calib_ros_check.outcome import CauseFinding, CauseState, CheckResult, CheckVerdict, Tolerance
from calib_ros_check.tolerance import ACCUSATION, MORE_FRAMES, is_off, judge, reason_of, undecided, unknown

Classified = Callable[[Sequence[int]], Sequence[FrameFeatures]]  # of the frames with these numbers
# Where nothing matches near the extrinsic: as far as a camera still sees what it is said to see.
FAR = SearchBox(25.0, 0.75)
CLASSIFIED_FRAMES = 4  # models of classes take as long as a search; more scenes would help, more frames of a few hardly
WIDER = (1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0)  # times the tolerance, for what does not pass
NOT_THE_CLOCKS = CauseFinding(Cause.TIME_OFFSET, CauseState.EXCLUDED, OTHER_FITS)
NOTHING_MATCHES = "nothing matches beyond chance, near or far"


@dataclass(frozen=True, eq=False)
class CheckInputs:
    """What is to be checked, and the inputs of the check besides the frames' features.

    T: T_camera_lidar (4, 4). classified: makes the features with classes, asked for in doubt; as_taken: makes those that another
    camera would have; None = they cannot be had. vehicle_frames: T_camera_F (4, 4) of frames F of the vehicle, by name, in which
    the clouds may be. progress: may raise, which ends the check.
    """

    T: Transform
    tolerance: Tolerance
    classified: Classified | None = None
    as_taken: AsTaken | None = None
    vehicle_frames: Mapping[str, Matrix] = field(default_factory=dict)
    progress: Callback | None = None


class Checker:
    """Checks extrinsics by frames of one camera.

    camera: the intrinsics that the frames were taken with, as they are claimed to be. config: all settings; any uncertainty is
    accepted. segmentation: the models of ``config.semantics``, where they are loaded already. scans: as of `Calibrator`.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        segmentation: Segmentation | None = None,
        scans: ScanEdges | None = None,
    ) -> None:
        config = config or Config()
        refine = {"tolerance_deg": NO_LIMIT_DEG, "tolerance_m": NO_LIMIT_M, "objective": "fast"}
        # Three searches look further than one would: more rounds of each hardly find another optimum.
        search = {"rounds": min(config.search.rounds, FRUITLESS_ROUNDS)}
        self.config = update(config, {"refine": refine, "search": search})
        self.camera = camera
        self._calibrator = Calibrator(camera, self.config, segmentation, scans=scans)
        self._judge = self._calibrator.judge
        as_stamped = update(self.config, {"motion": {"time_offset": "fixed"}})
        self._at_stamps = Calibrator(camera, as_stamped, self._calibrator.segmentation)
        # Another look is another chance of being wrong; with another seed, since a search misses an optimum now and then.
        further = {"search": {"seed": self.config.search.seed ^ 1}, "refine": {"max_p_value": self.config.refine.max_p_value / 2}}
        self._further = Calibrator(camera, update(self.config, further), self._calibrator.segmentation)

    def check(
        self,
        frames: Sequence[Frame],
        T_camera_lidar: ArrayLike,
        tolerance: Tolerance | None = None,
        progress: Callback | None = None,
        vehicle_frames: Mapping[str, Matrix] | None = None,
    ) -> CheckResult:
        """Check T_camera_lidar (4, 4) by frames, at least one. One that cannot be used is left out and noted.

        progress: called with the name of a stage and the share of it that is done, 0..1; may raise, which ends the check.
        vehicle_frames: T_camera_F (4, 4) of other frames F of the vehicle, by name, in which the clouds may really be. Raises
        BadInputError for no frames, frames of different cameras, or no rigid transform.
        """
        started, cpu = time.perf_counter(), time.process_time()
        T = se3.as_transform(T_camera_lidar, "the extrinsic")
        if not frames:
            raise BadInputError("no frames given; give at least one")
        calibrator = self._calibrator
        used, notes = usable_frames(frames, calibrator.extract, None, Progress(progress, "features"))

        def classified(numbers: Sequence[int]) -> Sequence[FrameFeatures]:
            watch, chosen = Progress(progress, "classes"), [used[k] for k in numbers]
            return with_classes(chosen, calibrator.extract, calibrator.segmentation, T, FAR, watch)[0]

        in_doubt = classified if calibrator.segmentation.active else None
        inputs = CheckInputs(T, tolerance or Tolerance(), in_doubt, calibrator.pictures_of(used), vehicle_frames or {}, progress)
        result = self.check_features([own for _, own in used], inputs)
        elapsed_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu
        return replace(result, notes=(*notes, *result.notes), elapsed_s=elapsed_s, cpu_s=cpu_s)

    def check_features(self, features: Sequence[FrameFeatures], inputs: CheckInputs) -> CheckResult:
        """The same from features; progress is called at least once for everything that is tried. Its time is for the caller to
        take."""
        result = self._found(features, inputs) if features else None
        if result is None:
            why = NOTHING_MATCHES if features else "no frame can be used"
            causes = findings(possible_causes(self.camera), CauseState.NOT_JUDGED, why)
            known = {"tolerance": inputs.tolerance, "T_checked": inputs.T, "T_estimated": None, "covariance": None}
            result = CheckResult(**vars(unknown()) | known, reason=f"{why}: {MORE_FRAMES}", causes=causes)
        return replace(
            result,
            frame_names=tuple(f.name or str(k) for k, f in enumerate(features)),
            data_stamp=max((f.stamp for f in features), default=0),
        )

    def _found(self, features: Sequence[FrameFeatures], inputs: CheckInputs) -> CheckResult | None:
        """The verdict about what the scenes show; None if nothing matches beyond chance."""
        optima: list[Matrix] = []
        both = [look(self._calibrator, features, box, inputs, optima) for box in (None, NEAR)]
        matches = [(own.evidence.z_score if own.evidence else -np.inf, own) for own in both if own is not None]
        z_score, near = max(matches, key=lambda own: own[0], default=(-np.inf, None))
        # What is off by more than NEAR is as rare as something mixed up, and is looked for afterwards.
        given = self._judge.as_given(features, inputs.T, optima)
        # Where the scenes match beyond doubt, only a picture can be another one: a transform would lead elsewhere.
        undoubted = z_score >= UNDOUBTED_Z
        tolerance, watch = inputs.tolerance, Progress(inputs.progress, "causes")
        asked = Question(features, inputs.T, None, inputs.as_taken, inputs.vehicle_frames, True, undoubted, near is None, watch)
        one = self._judge.explain(asked, given, tolerance.deg, tolerance.m)
        if one is not None:
            # What holds on most vehicles has to hold exactly; else its optimum tells how far the extrinsic is off.
            off = is_only_off(one, tolerance.deg, tolerance.m)
            told = findings(MIXED_UP, CauseState.EXCLUDED, OFF) if off else explained(one.hypothesis, self.camera)
            known = Result(one.T, CONVERGED, frames_used=len(features), evidence=Evidence(one.z_score, None, np.nan, np.nan))
            return self._judged(inputs, one, covariance_of(one.score, one.T), known, told, inputs.T if off else one.hypothesis.T)
        found = near or look(self._further, features, FAR, inputs, optima)
        if found is None and inputs.classified is not None:
            # Classes find what edges alone do not, and the other way round: a scene with few objects matches less by them.
            features = inputs.classified(spread_positions(CLASSIFIED_FRAMES, len(features)))
            found = look(self._further, features, FAR, inputs, optima)
        return None if found is None else self._at_optimum(features, found, inputs)

    def _at_optimum(self, features: Sequence[FrameFeatures], result: Result, inputs: CheckInputs) -> CheckResult:
        """The verdict, with clocks and intrinsics at the optimum of an estimate."""
        as_stamped = features
        features, result, clocks = self._on_right_clocks(features, result, inputs)
        if clocks.state is CauseState.FOUND:
            better = self._lens_instead(as_stamped, features, result, inputs)
            if better is not None:
                features, result, clocks = as_stamped, better, NOT_THE_CLOCKS
        found, C = result.T_camera_lidar, result.covariance
        score = self._judge.score(features, found)
        turned = None if se3.rotation_error_deg(inputs.T, found) <= inputs.tolerance.deg else inputs.T
        lens, fault = self._lens(score, found, result, inputs, turned)
        shared, whole = result.shared_covariance, result.covariance_with_intrinsics
        causes = lens_findings(lens, fault, "too few different scenes, or a very wide lens", self.camera)
        # An offset of the clocks may be another camera's doing.
        offset = 0.0 if clocks.state is CauseState.FOUND else clocks.values.get("seconds", 0.0)
        other = None if fault is not None else self._another_fisheye(score, found, inputs, offset)
        if other is not None:
            found, score, C, shared, whole = other.T, other.score, None, None, None
            causes = explained(other.hypothesis, self.camera)
            clocks = NOT_THE_CLOCKS if clocks.state is CauseState.FOUND else clocks
        elif lens is not None and fault is not None:
            score, T = lens.seen(score)
            found = refined(score, T, unlimited(T), NEAR_LEVELS, TOLERANCE_DEG)[0]
            shared = lens.left_open
            C = whole = covariance_of(score, found) + shared
        elif lens is not None and clocks.state is not CauseState.FOUND and not inputs.tolerance.covers(inputs.T, found):
            own = lens_for_mount(lens, inputs.T, inputs.tolerance, self.camera)
            causes = tuple(own if own is not None and own.cause is finding.cause else finding for finding in causes)
        C = covariance_of(score, found) if C is None else C
        causes = (clocks, *causes)
        blamed, right = any(own.state is CauseState.FOUND for own in causes), inputs.tolerance.covers(inputs.T, found)
        why = OTHER_FITS if blamed else AS_GIVEN if right else OFF
        causes = (*causes, *findings(MIXED_UP, CauseState.EXCLUDED, why))
        return self._judged(inputs, Match(score, found), C, result, causes, inputs.T, shared, whole)

    def _lens(
        self, score: PointScore, T: Matrix, result: Result, inputs: CheckInputs, turned: Matrix | None = None
    ) -> tuple[LensEstimate | None, Refusal | None]:
        """What the scenes tell of the lens at the optimum T (4, 4) of an estimate, and what is wrong of it with 99 %."""
        inflated = 1.0 if result.evidence is None else inflation(result.evidence.disagreement)
        lens = self._judge.lens(score, T, inflated, turned)
        fault = None if lens is None else lens.fault(self.camera, inputs.tolerance.deg, inputs.tolerance.m, ACCUSATION)
        return lens, fault if fault is not None and fault.code is RefusalCode.WRONG_INTRINSICS else None

    def _another_fisheye(self, score: PointScore, found: Matrix, inputs: CheckInputs, offset_s: float) -> Candidate | None:
        """A fisheye with another focal length, or one that is said to be rectified, if it explains the frames better than the
        camera as it is given does at the optimum (4, 4) of a score."""
        asks = shows_noise(score) and (score.camera.is_sphere or not inputs.tolerance.covers(inputs.T, found))
        guesses, others = [*fisheyes(found, self.camera)] if asks else [], list[Candidate]()
        asked = Question((), inputs.T, as_taken=inputs.as_taken)
        for guess in guesses:  # one after the other: each holds the maps of all frames
            with suppress(TooFewFeaturesError, BadInputError):
                own = self._judge.by_camera(guess, asked, (found, inputs.T), offset_s=offset_s)
                others += [] if own is None else [own]
        best = max(others, key=lambda own: own.z_score, default=None)
        better = best is not None and convinces(log_odds(best, Match(score, found)), rare_odds(len(guesses)))
        return best if better else None

    def _on_right_clocks(
        self, features: Sequence[FrameFeatures], result: Result, inputs: CheckInputs
    ) -> tuple[Sequence[FrameFeatures], Result, CauseFinding]:
        """Features, and their estimate, at the offset of the clocks that was found."""
        motion, seconds = self.config.motion, 0.0
        if result.refusal is RefusalCode.WRONG_TIMES:
            seconds = result.refusal_figures["seconds"]
        elif result.time_offset_s is not None:
            seconds = result.time_offset_s - motion.time_offset_s
        if seconds:
            features = [at_time_offset(f, seconds) for f in features]
        finding = clock_finding(features, result, seconds, inputs.tolerance, motion)
        if result.refusal is RefusalCode.WRONG_TIMES and result.optimum is not None:
            again = self._calibrator.estimate(features, result.optimum, None, inputs.progress)
            optimum = again.T_camera_lidar if again.converged else result.optimum
            names = ("covariance", "covariance_with_intrinsics", "shared_covariance")
            result = replace(result, T_camera_lidar=optimum, **{name: getattr(again, name) for name in names})
        return features, result, finding

    def _lens_instead(
        self, as_stamped: Sequence[FrameFeatures], moved: Sequence[FrameFeatures], result: Result, inputs: CheckInputs
    ) -> Result | None:
        """The estimate at the clocks as stamped, if another camera explains the frames better than the offset that was found; one
        may look like the other."""
        without = self._at_stamps.estimate(as_stamped, result.T_camera_lidar, None, inputs.progress)
        T = without.T_camera_lidar if without.converged else without.optimum
        if T is None:
            return None
        before, after = self._judge.score(as_stamped, T), self._judge.score(moved, result.T_camera_lidar)
        if not shows_lens(before):
            return None
        noise = noise_of(before, T, unlimited(T))
        gain = (after.at(-1).value(result.T_camera_lidar) - before.at(-1).value(T)) / noise
        lens, fault = self._lens(before, T, without, inputs)
        better = lens is not None and fault is not None and lens.gain - PARAMETER_PENALTY * (len(lens.unknowns) - 1) > gain
        return replace(without, T_camera_lidar=T, status=CONVERGED) if better else None

    def _judged(
        self,
        inputs: CheckInputs,
        found: Match,
        C: Covariance,
        result: Result,
        causes: tuple[CauseFinding, ...],
        T: Transform,
        shared: Covariance | None = None,
        whole: Covariance | None = None,
    ) -> CheckResult:
        """The verdict about what was found. C: (6, 6) of a left twist, with the camera as it is; shared: what other scenes have
        in common; whole: with the intrinsics. T: the extrinsic that was checked, with what was mixed up put right."""
        tolerance, whole = inputs.tolerance, C if whole is None else whole
        judgement = judge(T, found.T, C, tolerance, freedom(found.score), shared)
        if judgement.verdict is CheckVerdict.FAIL:  # what another lens may be to blame for is not the mount's
            judgement = judge(T, found.T, whole, tolerance, freedom(found.score), shared)
        if judgement.verdict is CheckVerdict.FAIL and not is_off(found, C if shared is None else C - shared, T, tolerance):
            judgement = undecided(judgement)
        cause, evidence = next((own for own in causes if own.state is CauseState.FOUND), None), result.evidence
        opened = judgement.verdict is CheckVerdict.INCONCLUSIVE and cause is None
        wider = [Tolerance(min(k * tolerance.deg, 90.0), min(k * tolerance.m, 10.0)) for k in WIDER if opened]
        verdicts = (judge(T, found.T, C, own, freedom(found.score), shared).verdict for own in wider)
        at = next((own for own, by in zip(wider, verdicts, strict=True) if by is CheckVerdict.PASS), None)
        return CheckResult(
            **vars(judgement) | {"verdict": judgement.verdict if cause is None else CheckVerdict.FAIL},
            reason=reason_of(judgement, tolerance, cause, [own for own in causes if own.state is CauseState.POSSIBLE]),
            tolerance=tolerance,
            T_checked=inputs.T,
            T_estimated=found.T,
            covariance=C,
            covariance_with_intrinsics=whole,
            shared_covariance=shared,
            causes=complete(causes, self.camera),
            time_offset_s=result.time_offset_s,
            time_offset_sigma_s=result.time_offset_sigma_s,
            z_score=evidence.z_score if evidence else np.nan,
            p_value=evidence.p_value if evidence else np.nan,
            frames_used=result.frames_used,
            notes=() if at is None else (f"passes from {at} on",),
        )


def covariance_of(score: PointScore, T: Transform) -> Covariance:
    """Covariance (6, 6) of an optimum T (4, 4)."""
    return covariance(score, T, inflation=inflation(disagreement(score, T, unlimited(T))))


def look(
    calibrator: Calibrator, features: Sequence[FrameFeatures], box: SearchBox | None, inputs: CheckInputs, optima: list[Matrix]
) -> Result | None:
    """The match of a refinement (None), or of a search in a box, from the extrinsic; None if it is one of chance. optima: its
    T_camera_lidar (4, 4) is added, by chance or not."""
    result = calibrator.estimate(features, inputs.T, box, inputs.progress)
    optimum = result.T_camera_lidar if result.converged else result.optimum
    if optimum is not None:
        optima.append(optimum)
    if result.refusal is RefusalCode.WRONG_TIMES and result.evidence is not None:  # an optimum that matches for all that
        return result if result.evidence.p_value <= calibrator.config.refine.max_p_value else None
    return result if result.converged else None

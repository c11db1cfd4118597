"""The check of an extrinsic by frames of one recording.

`Checker.check_features` is the whole of it: does an optimum near the extrinsic match beyond chance? If none does, was something
mixed up, or is the extrinsic far off? Then what is left: clocks, intrinsics, and the size of the error, judged by the tolerance.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.camera import Camera
from calib_ros.config import CameraConfig, Config, update
from calib_ros.config.registration import NO_LIMIT_DEG, NO_LIMIT_M
from calib_ros.datasets.positions import spread_positions
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.registration.acceptance.split_half import inflation
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.classes import Segmentation
from calib_ros.registration.features import FeatureExtractor, FrameFeatures, ScanEdges, at_time_offset
from calib_ros.registration.frames import usable_frames, with_classes
from calib_ros.registration.judgement.lens import LensEstimate, LensFault, estimate_lens, lens_unknowns
from calib_ros.registration.nuisance.parameters import NEAR_LEVELS, TOLERANCE_DEG, noise_of, refined
from calib_ros.registration.progress import Callback, Progress
from calib_ros.registration.score.chance import UNDOUBTED_Z
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.registration.search.search import FRUITLESS_ROUNDS
from calib_ros.result import CONVERGED, RefusalCode, Result
from calib_ros_check.alternatives import (
    NEAR,
    NOT_JUDGED,
    Alternatives,
    CheckInputs,
    Explanation,
    covariance_of,
    look,
    match_of,
)
from calib_ros_check.cameras import (
    CameraGuess,
    gain_over,
    other_centre,
    other_focal_lengths,
    rectified_already,
    unrectified_fisheye,
)
from calib_ros_check.causes import (
    AS_GIVEN,
    OFF,
    OTHER_FITS,
    centre_finding,
    clock_finding,
    complete,
    distorts,
    findings,
    instead,
    lens_findings,
    not_mixed_up,
    of_cameras,
    possible_causes,
)
from calib_ros_check.evidence import PARAMETER_PENALTY, Candidate, freedom, is_off, shows_noise
from calib_ros_check.outcome import Cause, CauseFinding, CauseState, CheckResult, CheckVerdict, Tolerance
from calib_ros_check.sensors import LensChange, centre_instead, centre_of, judged
from calib_ros_check.tolerance import ACCUSATION, MORE_FRAMES, judge, reason_of, undecided, unknown

# Where nothing matches near the extrinsic: as far as a camera still sees what it is said to see.
FAR = SearchBox(25.0, 0.75)
CLASSIFIED_FRAMES = 4  # models of classes take as long as a search; more scenes would help, more frames of a few hardly
CENTRES = 3  # principal points that are tried, one after the other
NOT_THE_CLOCKS = CauseFinding(Cause.TIME_OFFSET, CauseState.EXCLUDED, OTHER_FITS)
NOTHING_MATCHES = "nothing matches beyond chance, neither near the extrinsic nor elsewhere"


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
        self._alternatives = Alternatives(self._calibrator, camera)
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

        def as_taken(camera: Camera, numbers: Sequence[int] | None) -> Sequence[FrameFeatures]:
            extract = FeatureExtractor(camera, self.config)
            chosen = used if numbers is None else [used[k] for k in numbers]
            return [extract.seen_anew(own, frame.image) for frame, own in chosen]

        in_doubt = classified if calibrator.segmentation.active else None
        inputs = CheckInputs(T, tolerance or Tolerance(), in_doubt, as_taken, vehicle_frames or {}, progress)
        result = self.check_features([own for _, own in used], inputs)
        elapsed_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu
        return replace(result, notes=(*notes, *result.notes), elapsed_s=elapsed_s, cpu_s=cpu_s)

    def check_features(self, features: Sequence[FrameFeatures], inputs: CheckInputs) -> CheckResult:
        """The same from features; progress is called at least once for everything that is tried. Its time is for the caller to
        take."""
        found = self._find(features, inputs) if features else None
        if found is not None:
            result = self._judged(found, inputs)
        else:
            result = self._nothing_found(inputs, NOTHING_MATCHES if features else "no frame can be used")
        return replace(
            result,
            frame_names=tuple(f.name or str(k) for k, f in enumerate(features)),
            data_stamp=max((f.stamp for f in features), default=0),
        )

    def _find(self, features: Sequence[FrameFeatures], inputs: CheckInputs) -> Explanation | None:
        """What the scenes show; None if nothing matches beyond chance."""
        optima: list[Matrix] = []
        alternatives = self._alternatives
        both = [look(self._calibrator, features, box, inputs, optima) for box in (None, NEAR)]
        near = max((own for own in both if own is not None), key=match_of, default=None)
        # What is off by more than NEAR is as rare as something mixed up, and is looked for afterwards.
        given = alternatives.as_given(features, inputs.T, optima)
        # Where the scenes match beyond doubt, only a picture can be another one: a transform would lead elsewhere.
        tried = alternatives.hypotheses(features, inputs, near is not None and match_of(near) >= UNDOUBTED_Z)
        explained = alternatives.mixed_up(features, inputs, tried, given)
        if explained is None and near is None:
            explained = alternatives.another_camera(features, inputs, given, len(tried))
        if explained is not None:
            return explained
        found = near or look(self._further, features, FAR, inputs, optima)
        if found is None and inputs.classified is not None:
            # Classes find what edges alone do not, and the other way round: a scene with few objects matches less by them.
            features = inputs.classified(spread_positions(CLASSIFIED_FRAMES, len(features)))
            found = look(self._further, features, FAR, inputs, optima)
        return None if found is None else self._at_optimum(features, found, inputs)

    def _at_optimum(self, features: Sequence[FrameFeatures], result: Result, inputs: CheckInputs) -> Explanation:
        """Clocks and intrinsics at the optimum of an estimate."""
        as_stamped = features
        features, result, clocks = self._on_right_clocks(features, result, inputs)
        if clocks.state is CauseState.FOUND:
            better = self._lens_instead(as_stamped, features, result, inputs)
            if better is not None:
                features, result = as_stamped, better
                clocks = NOT_THE_CLOCKS
        found, C = result.T_camera_lidar, result.covariance
        score = self._alternatives.score(features, found)
        turned = None if se3.rotation_error_deg(inputs.T, found) <= inputs.tolerance.deg else inputs.T
        lens, fault = self._lens(score, found, result, inputs, turned)
        shared = result.shared_covariance
        causes = lens_findings(lens, fault, NOT_JUDGED, self.camera, inputs.tolerance)
        # An offset of the clocks may be another camera's doing.
        offset = 0.0 if clocks.state is CauseState.FOUND else clocks.values.get("seconds", 0.0)
        others = self._other_cameras(score, found, inputs, offset)
        least = 0.0 if lens is None or fault is None else max(lens.gain - PARAMETER_PENALTY, 0.0)
        significant = [own for own in others if own.significant and own.penalised_gain > least]
        if significant:
            found, score, C, shared = significant[0].T, significant[0].score, None, None
            causes = instead(significant[0].hypothesis.finding, of_cameras(self.camera))
            if clocks.state is CauseState.FOUND:
                clocks = NOT_THE_CLOCKS
        elif lens is not None and (fault is not None or not inputs.tolerance.covers(inputs.T, found)):
            seen, T = lens.seen(score)
            if fault is not None or inputs.tolerance.covers(inputs.T, T):  # a usual lens explains it
                score, found = seen, refined(seen, T, unlimited(T), NEAR_LEVELS, TOLERANCE_DEG)[0]
                shared = lens.left_open
                C = covariance_of(score, found) + shared
            elif clocks.state is not CauseState.FOUND:
                own = self._possible_centre(score, found, inputs, others)
                causes = tuple(own if own is not None and own.cause is finding.cause else finding for finding in causes)
        C = covariance_of(score, found) if C is None else C
        causes = (clocks, *causes)
        why = AS_GIVEN if inputs.tolerance.covers(inputs.T, found) else OFF
        if any(own.state is CauseState.FOUND for own in causes):
            why = OTHER_FITS
        return Explanation(score, found, C, inputs.T, result, (*causes, *not_mixed_up(why)), shared)

    def _lens(
        self, score: PointScore, T: Matrix, result: Result, inputs: CheckInputs, turned: Matrix | None = None
    ) -> tuple[LensEstimate | None, LensFault | None]:
        """What the scenes tell of the lens at the optimum T (4, 4) of an estimate, and what is wrong of it with 99 %."""
        known = self.config.camera if self.config.camera.focal_sigma else CameraConfig()  # to a check no lens is exact
        unknowns = lens_unknowns(known, self.camera, score.camera) if judged(score) else ()
        inflated = 1.0 if result.evidence is None else inflation(result.evidence.disagreement)
        lens = estimate_lens(score, T, unlimited(T), unknowns, inflated, turned=turned)
        fault = None if lens is None else lens.fault(inputs.tolerance.deg, inputs.tolerance.m, ACCUSATION)
        return lens, fault if fault is not None and fault.probability == 1 else None

    def _other_cameras(
        self, score: PointScore, found: Matrix, inputs: CheckInputs, offset_s: float
    ) -> list[Candidate[CameraGuess]]:
        """Other cameras that may have taken pictures with a distortion, around the optimum (4, 4) of a score, the best first."""
        if not shows_noise(score):
            return []
        off = se3.rotation_error_deg(inputs.T, found) > inputs.tolerance.deg
        guesses = [*rectified_already(self.camera)]
        if score.camera.is_sphere:
            guesses += other_focal_lengths(self.camera)
        if not inputs.tolerance.covers(inputs.T, found):
            guesses += unrectified_fisheye(self.camera)
        others = list(self._alternatives.cameras(guesses, (found, inputs.T), inputs, offset_s))
        others += self._other_centres(found, inputs, offset_s) if off else []
        best_first = sorted(others, key=lambda own: -own.z_score)
        return [gain_over(score, found, own, len(others)) for own in best_first]

    def _other_centres(self, found: Matrix, inputs: CheckInputs, offset_s: float) -> list[Candidate[CameraGuess]]:
        """Principal points that look like the rotation to the optimum (4, 4), each better than the one before it: at first, the
        optimum is one of blurred edges."""
        out: list[Candidate[CameraGuess]] = []
        centre, T = LensChange(), found
        for _ in range(CENTRES):
            step = centre_of(self.camera, inputs.T, T)
            centre = LensChange(u=centre.u + step.u, v=centre.v + step.v)
            guesses = other_centre(self.camera, centre, se3.from_parts(inputs.T[:3, :3], T[:3, 3]))
            match = next(self._alternatives.cameras(guesses, (), inputs, offset_s), None)
            if match is None or (out and match.z_score <= out[-1].z_score):
                break
            out.append(match)
            T = match.T
            if inputs.tolerance.covers(inputs.T, T):
                break
        return out

    def _possible_centre(
        self, score: PointScore, found: Matrix, inputs: CheckInputs, others: Sequence[Candidate[CameraGuess]]
    ) -> CauseFinding | None:
        """A principal point that explains the frames as well as the rotation to the optimum (4, 4) of a score does."""
        T, tolerance, centre = inputs.T, inputs.tolerance, None
        if not distorts(self.camera):
            centre = centre_instead(score, T, found, tolerance)
        for own in others:
            is_centre = own.hypothesis.finding.cause is Cause.PRINCIPAL_POINT
            if is_centre and tolerance.covers(T, own.T) and -own.gain <= PARAMETER_PENALTY:
                centre = centre_of(self.camera, T, found)
        return None if centre is None else centre_finding(centre, self.camera, CauseState.POSSIBLE)

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
            result = replace(result, T_camera_lidar=optimum, covariance=again.covariance)
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
        before, after = self._alternatives.score(as_stamped, T), self._alternatives.score(moved, result.T_camera_lidar)
        if not judged(before):
            return None
        noise = noise_of(before, T, unlimited(T))
        gain = (after.at(-1).value(result.T_camera_lidar) - before.at(-1).value(T)) / noise
        lens, fault = self._lens(before, T, without, inputs)
        better = lens is not None and fault is not None and lens.gain - PARAMETER_PENALTY * (len(lens.unknowns) - 1) > gain
        return replace(without, T_camera_lidar=T, status=CONVERGED) if better else None

    def _judged(self, found: Explanation, inputs: CheckInputs) -> CheckResult:
        """The verdict about what was found."""
        tolerance = inputs.tolerance
        judgement = judge(found.T_corrected, found.T, found.covariance, tolerance, freedom(found.score), found.shared)
        told = found.covariance if found.shared is None else found.covariance - found.shared  # by the scenes themselves
        if judgement.verdict is CheckVerdict.FAIL and not is_off(found, told, found.T_corrected, tolerance):
            judgement = undecided(judgement)
        cause = next((own for own in found.causes if own.state is CauseState.FOUND), None)
        result, evidence = found.result, found.result.evidence
        return CheckResult(
            **vars(judgement) | {"verdict": judgement.verdict if cause is None else CheckVerdict.FAIL},
            reason=reason_of(judgement, tolerance, cause, [own for own in found.causes if own.state is CauseState.POSSIBLE]),
            tolerance=tolerance,
            T_checked=inputs.T,
            T_estimated=found.T,
            covariance=found.covariance,
            shared_covariance=found.shared,
            causes=complete(found.causes, self.camera),
            time_offset_s=result.time_offset_s,
            time_offset_sigma_s=result.time_offset_sigma_s,
            z_score=evidence.z_score if evidence else np.nan,
            p_value=evidence.p_value if evidence else np.nan,
            frames_used=result.frames_used,
        )

    def _nothing_found(self, inputs: CheckInputs, why: str) -> CheckResult:
        causes = findings(possible_causes(self.camera), CauseState.NOT_JUDGED, why)
        known = {"tolerance": inputs.tolerance, "T_checked": inputs.T, "T_estimated": None, "covariance": None}
        return CheckResult(**vars(unknown()) | known, reason=f"{why}; {MORE_FRAMES}", causes=causes)

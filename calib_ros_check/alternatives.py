"""Explanations that another extrinsic does not give: something was mixed up, or another camera took the pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.errors import TooFewFeaturesError
from calib_ros.registration.acceptance.significance import UNDOUBTED_Z, p_value
from calib_ros.registration.acceptance.split_half import disagreement, inflation
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.covariance import covariance
from calib_ros.registration.features import FrameFeatures, at_time_offset
from calib_ros.registration.progress import Callback, Progress
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.registration.search.search import search_decoy
from calib_ros.result import CONVERGED, Evidence, Result
from calib_ros_check.cameras import AsTaken, CameraGuess, camera_guesses, turned_over
from calib_ros_check.candidate import Candidate, fit
from calib_ros_check.causes import MIXED_UP, OFF, OTHER_FITS, distorts, instead, lens_findings, not_mixed_up, of_cameras
from calib_ros_check.hypotheses import (
    SLACK,
    MixUp,
    hypotheses,
    of_pictures,
    predicted,
    says_more_than,
    simplest,
    upside_down,
)
from calib_ros_check.outcome import Cause, CauseFinding, Tolerance
from calib_ros_check.sensors import LensFit, fit_lens, judged, lenses

Classified = Callable[[], Sequence[FrameFeatures]]
NEAR_DEG, NEAR_M = 5.0, 0.5  # where mounts slip and hands miss
NEAR = SearchBox(NEAR_DEG, NEAR_M)
NOT_JUDGED = "one or two frames do not tell, nor do unrolled pictures of wide lenses"
LENS, MIX_UPS = "intrinsics", "causes"  # stages that progress tells of, besides those of an estimate
OF_PICTURES = {Cause.MIRRORED_IMAGE, Cause.ROTATED_IMAGE}
CONFIRMED = 3  # of the hypotheses with the best matches, how many are compared with a decoy


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


@dataclass(frozen=True, eq=False)
class Explanation:
    """What the scenes show. T: (4, 4), the extrinsic; covariance: (6, 6) of a left twist. T_corrected: the extrinsic that was
    checked, with what was mixed up put right. result: of the estimate."""

    T: Transform
    covariance: Covariance
    T_corrected: Transform
    result: Result
    causes: tuple[CauseFinding, ...] = ()


class Alternatives:
    """Tries all explanations by something else than the mount.

    calibrator: makes the scores. camera: as it is claimed to be.
    """

    def __init__(self, calibrator: Calibrator, camera: Camera) -> None:
        self._calibrator, self.camera = calibrator, camera
        self.config = calibrator.config

    def cameras(
        self, guesses: Iterable[CameraGuess], starts: Sequence[Matrix], inputs: CheckInputs, offset_s: float = 0.0
    ) -> Iterator[Candidate[CameraGuess]]:
        """The matches of other cameras near any of the starts (4, 4), one after the other; none without the pictures. offset_s:
        of the clocks, as found."""
        if inputs.as_taken is None:
            return
        for guess in guesses:
            with suppress(TooFewFeaturesError):
                features = inputs.as_taken(guess.camera)
                if offset_s:
                    features = [at_time_offset(f, offset_s) for f in features]
                own = starts if guess.start is None else (guess.start,)
                yield max((fit(guess, self.score(features, T), T) for T in own), key=_z_score)

    def mixed_up(
        self, features: Sequence[FrameFeatures], inputs: CheckInputs, tried: Sequence[Candidate[MixUp]]
    ) -> Explanation | None:
        """The explanation by something that was mixed up, or a camera that is quite another, if one matches beyond chance. tried:
        all hypotheses about these features, see `hypotheses`."""
        sure = bool(tried) and tried[0].z_score >= UNDOUBTED_Z
        lens = None if sure else self._other_lens(features, inputs)
        for one in tried[:CONFIRMED]:
            if lens is not None and lens.z_score >= one.z_score:
                break
            if self._beyond_chance(one, len(tried)):
                return _explained(simplest(one, tried), features, inputs)
        changes = list(lenses(features[0].camera, wide=True))
        if lens is not None and self._beyond_chance(lens, len(tried) + len(changes)):
            return _other_camera(lens, features, inputs, lens_findings(lens, NOT_JUDGED, self.camera))
        guesses = list(camera_guesses(self.camera))
        count = len(tried) + len(changes) + len(guesses)
        # One after the other: each holds the maps of all frames.
        other = max(self.cameras(guesses, (inputs.T,), inputs), key=_z_score, default=None)
        if other is not None and self._beyond_chance(other, count):
            return _other_camera(other, features, inputs, instead(other.hypothesis.finding, of_cameras(self.camera)))
        return None

    def undoubted(
        self, features: Sequence[FrameFeatures], inputs: CheckInputs, tried: Sequence[Candidate[MixUp]]
    ) -> Explanation | None:
        """The explanation by transforms that were mixed up, if it leaves no doubt without any search.

        Beyond all doubt, and about where a hypothesis predicts it, a match far from the extrinsic is where the sensors are.
        Mirrored and turned pictures are not among them: a symmetric scene matches its mirror image, and an extrinsic that is off
        may match better. tried: all hypotheses about these features, see `hypotheses`.
        """
        if not tried or tried[0].z_score < UNDOUBTED_Z:
            return None
        one = simplest(tried[0], tried)
        deg, m = se3.rotation_error_deg(inputs.T, one.T), se3.translation_error_m(inputs.T, one.T)
        near = deg <= NEAR_DEG and m <= NEAR_M
        in_doubt = near or predicted(one) > SLACK or OF_PICTURES & {tried[0].hypothesis.cause, one.hypothesis.cause}
        return None if in_doubt else _explained(one, features, inputs)

    def hypotheses(self, features: Sequence[FrameFeatures], inputs: CheckInputs) -> list[Candidate[MixUp]]:
        """All that may have been mixed up and says more than that the extrinsic is off, the best match first."""
        poses = [f.points.pose for f in features]
        tried = self._tried(features, hypotheses(inputs.T, features[0].camera, poses, inputs.vehicle_frames), inputs.progress)
        if inputs.as_taken is not None and distorts(self.camera):  # rectified upside down, a picture is bent
            with suppress(TooFewFeaturesError):
                guess = upside_down(inputs.T)
                tried.append(_fit_mix_up(guess, self.score(inputs.as_taken(turned_over(self.camera)), guess.T)))
        return sorted((own for own in tried if says_more_than(own, inputs.T)), key=lambda own: -own.z_score)

    def _tried(
        self, features: Sequence[FrameFeatures], guesses: Sequence[MixUp], progress: Callback | None
    ) -> list[Candidate[MixUp]]:
        """All hypotheses that leave enough points in view, the best match first."""
        tried, watch, atlas = [], Progress(progress, MIX_UPS), None
        for k, guess in enumerate(guesses):
            watch(k / len(guesses))
            with suppress(TooFewFeaturesError):
                score = self.score(features, guess.T, atlas)
                atlas = score.atlas  # one for all: each would take as much memory as the maps of all frames
                tried.append(_fit_mix_up(guess, score))
        return sorted(tried, key=lambda own: -own.z_score)

    def best_picture(self, features: Sequence[FrameFeatures], inputs: CheckInputs) -> float:
        """z-score of the best match of a mirrored or turned picture."""
        tried = self._tried(features, list(of_pictures(inputs.T, features[0].camera)), inputs.progress)
        return tried[0].z_score if tried else -np.inf

    def _other_lens(self, features: Sequence[FrameFeatures], inputs: CheckInputs) -> LensFit | None:
        """The best match of another camera near the extrinsic; None if none matches clearly better, or it cannot be judged."""
        try:
            score = self.score(features, inputs.T)
        except TooFewFeaturesError:
            return None
        if not judged(score):
            return None
        best = fit_lens(score, inputs.T, wide=True, progress=Progress(inputs.progress, LENS))
        return replace(best, score=best.hypothesis.seen_by(score)) if best.significant else None

    def _beyond_chance(self, best: Candidate[Any], tried: int) -> bool:
        """Does the best match of so many that were tried exceed what a decoy reaches?"""
        if best.z_score >= UNDOUBTED_Z:
            return True
        decoy = search_decoy(best.score, best.T, NEAR, self.config.search, unlimited(best.T))
        return p_value(best.z_score, decoy, tried) <= self.config.refine.max_p_value

    def score(self, features: Sequence[FrameFeatures], T: Transform, atlas: Atlas | None = None) -> PointScore:
        """The score of all frames with the points that are near the image at T (4, 4). Raises TooFewFeaturesError. atlas: of
        another score of the same frames."""
        return self._calibrator.objectives(features, T, T, atlas=atlas).edges.score


def _fit_mix_up(guess: MixUp, score: PointScore) -> Candidate[MixUp]:
    """score: of the points that are near the image where the mix-up predicts the extrinsic."""
    return fit(guess, guess.seen_by(score), guess.T)


def _z_score(match: Candidate[Any]) -> float:
    return match.z_score


def _other_camera(
    match: Candidate[Any], features: Sequence[FrameFeatures], inputs: CheckInputs, findings: Iterable[CauseFinding]
) -> Explanation:
    causes = (*findings, *not_mixed_up(OTHER_FITS))
    return Explanation(match.T, covariance_of(match.score, match.T), inputs.T, _matched(match, features), causes)


def _explained(one: Candidate[MixUp], features: Sequence[FrameFeatures], inputs: CheckInputs) -> Explanation:
    """What a hypothesis says. One that holds on most vehicles, nearly, has to hold exactly; else its optimum tells how far the
    extrinsic is off."""
    C = covariance_of(one.score, one.T)
    if one.hypothesis.usual and not inputs.tolerance.covers(one.hypothesis.T, one.T):
        return Explanation(one.T, C, inputs.T, _matched(one, features), not_mixed_up(OFF))
    return Explanation(one.T, C, one.hypothesis.T, _matched(one, features), instead(one.hypothesis.finding, MIXED_UP))


def _matched(match: Candidate[Any], features: Sequence[FrameFeatures]) -> Result:
    """What is known of a match that is no estimate."""
    return Result(match.T, CONVERGED, frames_used=len(features), evidence=Evidence(match.z_score, None, np.nan, np.nan))


def covariance_of(score: PointScore, T: Transform) -> Covariance:
    """Covariance (6, 6) of an optimum T (4, 4)."""
    return covariance(score, T, inflation=inflation(disagreement(score, T, unlimited(T))))

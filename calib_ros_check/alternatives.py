"""Explanations that another extrinsic does not give: something was mixed up, or another camera took the pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import Any

import numpy as np

from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.datasets.positions import spread_positions
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.registration.acceptance.split_half import disagreement, inflation
from calib_ros.registration.calibrator import Calibrator
from calib_ros.registration.covariance import covariance
from calib_ros.registration.features import FrameFeatures, at_time_offset
from calib_ros.registration.progress import Callback, Progress
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.chance import LOWEST_DECOY_Z, p_value
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import SearchBox, unlimited
from calib_ros.registration.search.search import search, search_decoy
from calib_ros.result import CONVERGED, Evidence, RefusalCode, Result
from calib_ros_check.cameras import AsTaken, CameraGuess, camera_guesses, turned_over
from calib_ros_check.causes import MIXED_UP, OFF, OTHER_FITS, changed_findings, distorts, instead, not_mixed_up, of_cameras
from calib_ros_check.evidence import EVEN, Candidate, H, Match, convinces, evidence, fit, log_odds, rare_odds
from calib_ros_check.hypotheses import MixUp, hypotheses, of_pictures, says_more_than, simplest, upside_down
from calib_ros_check.outcome import CauseFinding, Tolerance
from calib_ros_check.sensors import LensChange, LensFit, fit_lens, judged, lenses

Classified = Callable[[Sequence[int]], Sequence[FrameFeatures]]  # of the frames with these numbers
NEAR_DEG, NEAR_M = 5.0, 0.5  # where mounts slip and hands miss
NEAR = SearchBox(NEAR_DEG, NEAR_M)
NOT_JUDGED = "one scene does not tell, nor do unrolled pictures of wide lenses"
LENS, MIX_UPS = "intrinsics", "causes"  # stages that progress tells of, besides those of an estimate
CONFIRMED = 3  # of the hypotheses with the best matches, how many are compared with a decoy
Z_SCORE = attrgetter("z_score")
FEW_FRAMES = 3  # tell which camera may have taken the pictures


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
class Explanation(Match):
    """What the scenes show. covariance: (6, 6) of a left twist; shared: the part of it that intrinsics and clocks leave open.
    T_corrected: the extrinsic that was checked, with what was mixed up put right. result: of the estimate."""

    covariance: Covariance
    T_corrected: Transform
    result: Result
    causes: tuple[CauseFinding, ...] = ()
    shared: Covariance | None = None


class Alternatives:
    """Tries all explanations by something else than the mount.

    calibrator: makes the scores. camera: as it is claimed to be.
    """

    def __init__(self, calibrator: Calibrator, camera: Camera) -> None:
        self._calibrator, self.camera = calibrator, camera
        self.config = calibrator.config

    def cameras(
        self,
        guesses: Iterable[CameraGuess],
        starts: Sequence[Matrix],
        inputs: CheckInputs,
        offset_s: float = 0.0,
        frames: Sequence[int] | None = None,
    ) -> Iterator[Candidate[CameraGuess]]:
        """The matches of other cameras near any of the starts (4, 4), one after the other; none without the pictures. Guesses
        with which no picture can be rectified are left out. offset_s: of the clocks, as found. frames: None = all."""
        if inputs.as_taken is None:
            return
        for guess in guesses:
            with suppress(TooFewFeaturesError, BadInputError):
                features = inputs.as_taken(guess.camera, frames)
                if offset_s:
                    features = [at_time_offset(f, offset_s) for f in features]
                own = starts if guess.start is None else (guess.start,)
                yield max((fit(guess, self.score(features, T), T) for T in own), key=Z_SCORE)

    def as_given(self, features: Sequence[FrameFeatures], T: Transform, optima: Sequence[Matrix]) -> Match | None:
        """The best match of the sensors as they are given: the optimum near T (4, 4), as of every hypothesis, or one of the
        optima that were met, beyond chance or not. None if all of them see too few points."""
        matches: list[Match] = []
        atlas: Atlas | None = None
        for start in (T, *optima):
            with suppress(TooFewFeaturesError):
                score = self.score(features, start, atlas)
                atlas = score.atlas
                end = fit(LensChange(), score, start).T if start is T else start
                matches.append(Match(score, end))
        return max(matches, key=evidence, default=None)

    def mixed_up(
        self,
        features: Sequence[FrameFeatures],
        inputs: CheckInputs,
        tried: Sequence[Candidate[MixUp]],
        given: Match | None,
    ) -> Explanation | None:
        """The explanation by something that was mixed up, if one matches beyond chance, and convinces against the extrinsic being
        off. tried: all hypotheses about these features, see `hypotheses`. given: see `as_given`."""
        for best in tried[:CONFIRMED]:
            if not self._beyond_chance(best, len(tried)):
                break
            for one in (simplest(best, tried), best):
                odds = EVEN if _is_only_off(one, inputs) else rare_odds(len(tried))
                if self._stands(found := self._searched(one), given, len(tried), odds):
                    # What holds on most vehicles has to hold exactly; else its optimum tells how far the extrinsic is off.
                    if _is_only_off(found, inputs):
                        return _explanation(found, features, inputs.T, not_mixed_up(OFF))
                    return _explanation(found, features, found.hypothesis.T, instead(found.hypothesis.finding, MIXED_UP))
        return None

    def _stands(self, candidate: Candidate[Any], given: Match | None, tried: int, odds: float) -> bool:
        """Does one of so many that were tried match beyond chance, and convince against the sensors as they are given, at these
        odds in advance?"""
        return self._beyond_chance(candidate, tried) and convinces(log_odds(candidate, given), odds)

    def _searched(self, candidate: Candidate[H]) -> Candidate[H]:
        """The same at the best optimum that one round of a search near it finds: the sensors as given are searched as well."""
        box, limits = SearchBox(NEAR_DEG, NEAR_M, rounds=1), unlimited(candidate.T)
        T = search(candidate.score, candidate.T, box, self.config.search, limits, self.config.refine.max_p_value).T
        other = replace(candidate, T=T)
        return max(candidate, other, key=evidence)

    def another_camera(
        self, features: Sequence[FrameFeatures], inputs: CheckInputs, given: Match | None, tried: int
    ) -> Explanation | None:
        """The explanation by a camera that is quite another, by the same standard. tried: hypotheses so far.

        Which one it may be a few of the frames tell, and all of them whether it is: each takes all pictures anew.
        """
        some = spread_positions(FEW_FRAMES, len(features))
        lens, changes = self._other_lens(features, some, inputs), list(lenses(features[0].camera))
        count = tried + len(changes)
        if lens is not None and self._stands(lens, given, count, rare_odds(count)):
            findings = changed_findings(lens, self.camera)
            return _explanation(lens, features, inputs.T, (*findings, *not_mixed_up(OTHER_FITS)))
        guesses = list(camera_guesses(self.camera))
        count += len(guesses)
        # One after the other: each holds the maps of all frames.
        other = max(self.cameras(guesses, (inputs.T,), inputs, frames=some), key=Z_SCORE, default=None)
        if other is not None and len(some) < len(features):
            other = next(self.cameras([other.hypothesis], (inputs.T,), inputs), None)
        if other is not None and self._stands(other, given, count, rare_odds(count)):
            findings = instead(other.hypothesis.finding, of_cameras(self.camera))
            return _explanation(other, features, inputs.T, (*findings, *not_mixed_up(OTHER_FITS)))
        return None

    def hypotheses(
        self, features: Sequence[FrameFeatures], inputs: CheckInputs, only_pictures: bool = False
    ) -> list[Candidate[MixUp]]:
        """All that may have been mixed up, leaves enough points in view and says more than that the extrinsic is off, the best
        match first. only_pictures: not transforms."""
        camera, T = features[0].camera, inputs.T
        if only_pictures:
            guesses = list(of_pictures(T, camera))
        else:
            guesses = hypotheses(T, camera, [f.points.pose for f in features], inputs.vehicle_frames)
        tried, watch, atlas = [], Progress(inputs.progress, MIX_UPS), None
        for k, guess in enumerate(guesses):
            watch(k / len(guesses))
            with suppress(TooFewFeaturesError):
                score = self.score(features, guess.T, atlas)
                atlas = score.atlas  # one for all: each would take as much memory as the maps of all frames
                tried.append(fit(guess, guess.seen_by(score), guess.T))
        # Rectified upside down, a picture is bent.
        if not only_pictures and inputs.as_taken is not None and distorts(self.camera):
            with suppress(TooFewFeaturesError, BadInputError):
                guess = upside_down(T)
                tried.append(fit(guess, self.score(inputs.as_taken(turned_over(self.camera), None), guess.T), guess.T))
        return sorted((own for own in tried if says_more_than(own, T)), key=lambda own: -own.z_score)

    def _other_lens(self, features: Sequence[FrameFeatures], some: Sequence[int], inputs: CheckInputs) -> LensFit | None:
        """The best match of another camera near the extrinsic; None if none matches clearly better, or it cannot be judged.
        some: numbers of the frames that it is fitted to."""
        try:
            of_all = self.score(features, inputs.T)
            if not judged(of_all):
                return None
            score = self.score([features[k] for k in some], inputs.T)
            best = fit_lens(score, inputs.T, Progress(inputs.progress, LENS))
            return replace(best, score=best.hypothesis.seen_by(of_all)) if best.significant else None
        except TooFewFeaturesError:
            return None

    def _beyond_chance(self, best: Candidate[Any], tried: int) -> bool:
        """Does the best match of so many that were tried exceed what a decoy reaches?"""
        largest = self.config.refine.max_p_value
        if p_value(best.z_score, None, tried) <= largest:
            return True
        if p_value(best.z_score, LOWEST_DECOY_Z, tried) > largest:
            return False
        decoy = search_decoy(best.score, best.T, NEAR, self.config.search, unlimited(best.T))
        return p_value(best.z_score, decoy, tried) <= largest

    def score(self, features: Sequence[FrameFeatures], T: Transform, atlas: Atlas | None = None) -> PointScore:
        """The score of all frames with the points that are near the image at T (4, 4). Raises TooFewFeaturesError. atlas: of
        another score of the same frames."""
        return self._calibrator.objectives(features, T, T, atlas=atlas).edges.score


def _is_only_off(one: Candidate[MixUp], inputs: CheckInputs) -> bool:
    """Whether an optimum near what holds on most vehicles says no more than that the extrinsic is off."""
    return one.hypothesis.usual and not inputs.tolerance.covers(one.hypothesis.T, one.T)


def _explanation(
    match: Candidate[Any], features: Sequence[FrameFeatures], T_corrected: Transform, causes: Iterable[CauseFinding]
) -> Explanation:
    """Of a match that is no estimate."""
    known = Result(match.T, CONVERGED, frames_used=len(features), evidence=Evidence(match.z_score, None, np.nan, np.nan))
    return Explanation(match.score, match.T, covariance_of(match.score, match.T), T_corrected, known, tuple(causes))


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


def match_of(result: Result) -> float:
    """z-score of a match."""
    return result.evidence.z_score if result.evidence is not None else -np.inf

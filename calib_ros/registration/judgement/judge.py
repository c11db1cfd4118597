"""Which hypothesis explains frames that do not match as the sensors are given?

All are tried from where the extrinsic is if they hold; the best matches are searched, and have to stand out from chance and from
the sensors as they are given, at the odds of something so rare.

There is one standard of evidence for all explanations, that the extrinsic is as given, or off, or something was mixed up. Any two
are compared at the optimum of each: the difference of their scores over the noise of the score is a log-likelihood ratio, and has
to outweigh how rare the better one is in advance. One under which a scene is symmetric matches as well, and outweighs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import CameraConfig, Config
from calib_ros.datasets.source import spread_positions
from calib_ros.errors import BadInputError, TooFewFeaturesError
from calib_ros.intrinsics import FOCAL
from calib_ros.registration.covariance import disagreement, effective_points, freedom, inflation, noise_of, shows_lens
from calib_ros.registration.features import FrameFeatures, at_time_offset
from calib_ros.registration.judgement.hypotheses import (
    OF_PICTURE,
    AsTaken,
    Hypothesis,
    distorts,
    fisheyes,
    mix_ups,
    of_another_size,
    other_lenses,
    pictures,
    rectified_otherwise,
    resized,
    turned_over,
)
from calib_ros.registration.judgement.lens import LensEstimate, estimate_lens, lens_unknowns
from calib_ros.registration.judgement.refusal import GROSSLY
from calib_ros.registration.objective import ObjectiveMaker
from calib_ros.registration.progress import SILENT, Progress
from calib_ros.registration.score.atlas import Atlas
from calib_ros.registration.score.chance import LOWEST_DECOY_Z, null_distribution, p_value
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, SearchBox, unlimited
from calib_ros.registration.search.optimizers import LEVELS, NEAR_LEVELS, POINTS, REACH, TOLERANCE_DEG, refined
from calib_ros.registration.search.search import search_decoy, search_once
from calib_ros.result import Cause

NEAR = SearchBox(5.0, 0.5)  # where mounts slip and hands miss
CONFIRMED = 3  # of the hypotheses with the best matches, how many are searched
FEW_FRAMES = 3  # tell which camera may have taken the pictures
SLACK = 5.0  # of `_distance`: a turned picture moves the centre of a lens by some per cent of its width
ALIKE = 0.85  # of the best z-score; hypotheses that lead to the same extrinsic differ by the points that they keep in view
CONFIDENCE = 0.9  # probability from which a verdict is one
EVEN = 1.0  # prior odds, that an extrinsic which somebody checks is off
SHOWN_SIGMAS = 2.0  # of what a size lacks to the one that was tried


@dataclass(frozen=True, eq=False)
class Match:
    """An explanation at its optimum T (4, 4), with the score of the frames as they look if it holds."""

    score: PointScore
    T: Transform


@dataclass(frozen=True, eq=False)
class Candidate(Match):
    """A hypothesis at its optimum. searched: all of the box that is asked about, not only near where it predicts one. rarer:
    factor from its z-score to that of all frames."""

    hypothesis: Hypothesis
    searched: bool = False
    rarer: float = 1.0

    @cached_property
    def z_score(self) -> float:
        """Of the match, against extrinsics around it."""
        return self.rarer * null_distribution(self.score, self.T).z_score

    @property
    def surprise(self) -> float:
        """How far its optimum lies from what the hypothesis predicts, see `_distance`."""
        return _distance(self.T, self.hypothesis.T)

    def says_more_than(self, T: Transform) -> bool:
        """Whether the optimum is nearer to what was predicted than to the extrinsic T (4, 4) as it was given: else the latter is
        just off. A picture that is another one has no extrinsic that could be compared."""
        other = self.hypothesis.mirrored or any(self.hypothesis.lens) or self.hypothesis.of_lens
        return other or self.surprise < _distance(self.T, T)


@dataclass(frozen=True, eq=False)
class Question:
    """What is asked about frames.

    T: T_camera_lidar (4, 4) as it is given. box: about T, in which it is to be searched; None = it is right, or just off.
    as_taken: None = pictures cannot be rectified anew. frames: T_camera_F (4, 4) of frames F of the vehicle, by name, in which
    the clouds may be. stated: somebody has stated T; else it is a guess, and no transform was mixed up. only_pictures, thorough:
    fewer hypotheses, and also those that take long.
    """

    features: Sequence[FrameFeatures]
    T: Transform
    box: SearchBox | None = None
    as_taken: AsTaken | None = None
    frames: Mapping[str, Matrix] = field(default_factory=dict)
    stated: bool = True
    only_pictures: bool = False
    thorough: bool = False
    progress: Progress = SILENT

    @property
    def some(self) -> Sequence[int]:
        """Numbers of a few frames."""
        return spread_positions(FEW_FRAMES, len(self.features))


class Judge:
    """Tries what else than the mount may be wrong. objectives: make the scores. camera: as it is stated."""

    def __init__(self, objectives: ObjectiveMaker, config: Config, camera: Camera) -> None:
        self._objectives, self.config, self.camera = objectives, config, camera

    def score(self, features: Sequence[FrameFeatures], T: Transform, atlas: Atlas | None = None) -> PointScore:
        """The score of all frames with the points that are near the image at T (4, 4). Raises TooFewFeaturesError. atlas: of
        another score of the same frames."""
        return self._objectives(features, T, T, atlas=atlas).edges.score

    def as_given(self, features: Sequence[FrameFeatures], T: Transform, optima: Sequence[Matrix]) -> Match | None:
        """The best match of the sensors as they are given: the optimum near T (4, 4), as of every hypothesis, or one of the
        optima that were met, beyond chance or not. None if all of them see too few points."""
        matches: list[Match] = []
        for start in (T, *optima):
            with suppress(TooFewFeaturesError):
                score = self.score(features, start, matches[-1].score.atlas if matches else None)
                matches.append(Match(score, _optimum(score, start) if start is T else start))
        return max(matches, key=evidence, default=None)

    def explain(self, asked: Question, given: Match | None, deg: float, m: float) -> Candidate | None:
        """The hypothesis that explains the frames, if one matches beyond chance, and convinces against the extrinsic being off.
        given: see `as_given`. deg, m: the tolerance, within which an extrinsic is the same."""
        count, done = 0, set[Candidate]()
        for guesses in self._hypotheses(asked):  # until one explains the frames
            tried = self.tried(asked, guesses)
            count += len(tried)
            for best in tried[:CONFIRMED]:
                if asked.box is None and not self._beyond_chance(best, count):
                    break
                for one in (simplest(best, tried), best):
                    own = None if one in done else self._confirmed(one, asked)
                    done.add(one)
                    odds = rare_odds(count) if own is None or not is_only_off(own, deg, m) else EVEN
                    if own is None or not self._beyond_chance(own, count) or not convinces(log_odds(own, given), odds):
                        continue
                    if asked.box is None or own.hypothesis.of_lens:
                        return own
                    # Or a simpler one that predicts about the same optimum as well: a rough start ranks none.
                    simpler = (c for c in tried if c.hypothesis.rank < own.hypothesis.rank and not c.hypothesis.of_lens)
                    rivals = [c for c in simpler if _distance(c.hypothesis.T, own.T) <= own.surprise + SLACK]
                    others = (self._confirmed(c, asked) for c in rivals[:CONFIRMED])
                    return simplest(own, [own, *(c for c in others if c is not None)])
        return None

    def tried(self, asked: Question, guesses: Sequence[Hypothesis]) -> list[Candidate]:
        """The hypotheses that leave enough points in view, and say more than that the extrinsic is off, the best match first."""
        atlas: Atlas | None = None
        tried: list[Candidate] = []
        for k, guess in enumerate(guesses):
            asked.progress(k / len(guesses))
            with suppress(TooFewFeaturesError, BadInputError):
                if guess.camera is not None and not any(guess.lens):
                    few = self._by_few(guess, asked)
                    tried += [] if few is None else [few]
                    continue
                score = self.score(asked.features, guess.T, atlas)
                atlas = score.atlas  # one for all: each would take as much memory as the maps of all frames
                seen = guess.seen_by(score)
                own = Candidate(seen, _optimum(seen, guess.T), guess)
                if asked.box is not None and guess.cause in OF_PICTURE:  # the likeliest: they come with every extrinsic
                    own = self._searched(own, asked)
                tried.append(own)
        return sorted((own for own in tried if own.says_more_than(asked.T)), key=lambda own: -own.z_score)

    def by_camera(
        self,
        guess: Hypothesis,
        asked: Question,
        starts: Sequence[Transform] = (),
        numbers: Sequence[int] | None = None,
        offset_s: float = 0.0,
    ) -> Candidate | None:
        """A hypothesis whose pictures are rectified anew, once; None where they cannot be. starts: (4, 4), one of them near its
        optimum; none = where it predicts that. offset_s: of the clocks, as found. numbers: of the frames, None = all. Raises
        BadInputError where no picture can be rectified so, TooFewFeaturesError."""
        if asked.as_taken is None or guess.camera is None:
            return None
        features = asked.as_taken(guess.camera, numbers)
        if offset_s:
            features = [at_time_offset(f, offset_s) for f in features]
        found: list[Candidate] = []
        for start in starts or (guess.T,):
            score = self.score(features, start, found[-1].score.atlas if found else None)
            found.append(Candidate(score, _optimum(score, start), guess))
        return max(found, key=lambda own: own.z_score)

    def _by_few(self, guess: Hypothesis, asked: Question) -> Candidate | None:
        """The same by a few frames, searched where the extrinsic is not known: rectifying takes longer than a search."""
        own = self.by_camera(guess, asked, numbers=asked.some)
        if own is None:
            return None
        own = replace(own, rarer=math.sqrt(len(asked.features) / len(asked.some)))  # it grows with the root of the points
        return own if asked.box is None else self._searched(own, asked)

    def lens(self, score: PointScore, T: Transform, inflated: float, turned: Transform | None) -> LensEstimate | None:
        """What the scenes tell of the lens at an optimum T (4, 4); to a check no lens is exact. turned: see `estimate_lens`."""
        known = self.config.camera if self.config.camera.focal_sigma else CameraConfig()
        unknowns = lens_unknowns(known, self.camera, score.camera) if shows_lens(score) else ()
        return estimate_lens(score, T, unlimited(T), unknowns, inflated, turned=turned)

    def _hypotheses(self, asked: Question) -> Iterator[list[Hypothesis]]:
        """What is tried, one group after the other: what was mixed up, and then another camera's pictures."""
        T, working, distorted = asked.T, asked.features[0].camera, distorts(self.camera)
        if asked.only_pictures:
            yield list(pictures(T, working))
            return
        made = mix_ups(T, working, [f.points.pose for f in asked.features], asked.frames)
        made = [own for own in made if asked.stated or own.cause in (Cause.CLOUD_FRAME, *OF_PICTURE)]
        made += [turned_over(T, self.camera)] if distorted else []  # rectified upside down, a picture is bent
        sizes = [] if working.is_sphere else list(resized(T, self.camera, working, asked.thorough))
        made += [*rectified_otherwise(T, self.camera)] + ([] if asked.thorough and distorted else sizes)
        yield made
        if asked.thorough:
            yield [*(sizes if distorted else ()), *other_lenses(T, self.camera), *fisheyes(T, self.camera)]

    def _confirmed(self, one: Candidate, asked: Question) -> Candidate | None:
        """The same by all frames, at the best optimum that one round of a search near it finds, its lens refined; None where its
        pictures cannot be had, or do not match."""
        guess = one.hypothesis
        if guess.camera is None:
            one = one if one.searched else self._searched(one, asked)
        else:
            with suppress(TooFewFeaturesError, BadInputError):
                few = self._by_few(guess, asked) if any(guess.lens) else one
                if few is None or p_value(few.z_score, LOWEST_DECOY_Z) > self.config.refine.max_p_value:
                    return None
                anew = self.by_camera(guess, asked, (few.T,))
                if anew is None:
                    return None
                one = anew
        score, camera = one.score, one.score.camera
        if not guess.of_lens or not shows_lens(score):
            return one
        lens = estimate_lens(score, one.T, unlimited(one.T), lens_unknowns(CameraConfig(), camera, camera))
        if lens is None:
            return one
        seen, T = lens.seen(score)
        left, share = next((k for k, own in enumerate(lens.unknowns) if own.name == FOCAL), None), guess.lens[0]
        told = left is not None and abs(lens.change[left]) > SHOWN_SIGMAS * lens.sigma[left]
        if told and share and guess.cause is Cause.OTHER_CAMERA:
            guess = replace(guess, told=of_another_size((1 + share) * (1 + float(lens.change[left]))))
        T = refined(seen, T, unlimited(T), NEAR_LEVELS, TOLERANCE_DEG)[0]
        return max(one, replace(one, score=seen, T=T, hypothesis=guess), key=evidence)

    def _searched(self, one: Candidate, asked: Question) -> Candidate:
        """The same at the best optimum that one round of a search near it finds: the sensors as given are searched as well."""
        start = one.T if asked.box is None else one.hypothesis.T
        T = search_once(one.score, start, asked.box or NEAR, self.config.search, unlimited(start))
        return replace(max(one, replace(one, T=T), key=evidence), searched=True)

    def _beyond_chance(self, best: Candidate, tried: int) -> bool:
        """Does the best match of so many that were tried exceed what a decoy reaches?"""
        largest = self.config.refine.max_p_value
        if p_value(best.z_score, None, tried) <= largest:
            return True
        if p_value(best.z_score, LOWEST_DECOY_Z, tried) > largest:
            return False
        decoy_z = search_decoy(best.score, best.T, NEAR, self.config.search, unlimited(best.T))
        return p_value(best.z_score, decoy_z, tried) <= largest


def is_only_off(one: Candidate, deg: float, m: float) -> bool:
    """Whether an optimum near what holds on most vehicles says no more than that the extrinsic is off."""
    off = se3.error(one.hypothesis.T, one.T)
    return one.hypothesis.usual and not (off[0] <= deg and off[1] <= m)


def simplest(best: Candidate, tried: Sequence[Candidate]) -> Candidate:
    """Of all hypotheses that match about as well as the best one, that which predicts its optimum best; else the simplest."""
    alike = [own for own in tried if own is best or own.z_score >= ALIKE * best.z_score]
    nearest = min(own.surprise for own in alike)
    near = [own for own in alike if own.surprise <= nearest + SLACK]
    return min(near, key=lambda own: own.hypothesis.rank)


def _optimum(score: PointScore, start: Transform) -> Matrix:
    """Of a score near a start (4, 4)."""
    part = score.subset(POINTS, np.random.default_rng(0))
    return refined(part, start, Limits(start, REACH), LEVELS, TOLERANCE_DEG)[0]


def _distance(a: Matrix, b: Matrix) -> float:
    """Between two extrinsics (4, 4), in units of half a degree and 10 cm."""
    xi = se3.log(a @ se3.inverse(b))
    return float(np.rad2deg(np.linalg.norm(xi[:3])) / 0.5 + np.linalg.norm(xi[3:]) / 0.1)


def evidence(match: Match) -> float:
    """What the points together say for a match: their score times how many there are, since other extrinsics see others."""
    return match.score.at(-1).value(match.T) * effective_points(match.score)


def log_odds(better: Match, other: Match | None) -> float:
    """Log-likelihood ratio of two matches of the same frames, by the noise at the better one; negative if it is none. other: None
    = nothing is in view.

    Student's distribution: few regions tell their own noise badly. Noise is inflated by the disagreement of halves.
    """
    score, T = better.score, better.T
    noise = noise_of(score, T, unlimited(T)) * inflation(disagreement(score, T, unlimited(T)))
    gain = (evidence(better) - (evidence(other) if other is not None else 0.0)) / effective_points(score) / noise
    degrees = freedom(score)
    return math.copysign(0.5 * (degrees + 1) * math.log1p(2 * abs(gain) / degrees), gain)


def convinces(log_ratio: float, prior_odds: float) -> bool:
    """Whether an explanation is more probable than another one by CONFIDENCE."""
    return math.log(prior_odds) + log_ratio >= math.log(CONFIDENCE / (1 - CONFIDENCE))


def rare_odds(tried: int) -> float:
    """Prior odds of one of so many explanations, all of which together are GROSSLY rare."""
    return GROSSLY / (1 - GROSSLY) / tried

"""The registration from guesses of the extrinsic, by classes, motion or whatever is available: the best that comes out counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.arrays import Matrix
from calib_ros.errors import BadInputError, MissingDependencyError, TooFewFeaturesError
from calib_ros.frame import Frame
from calib_ros.registration.classes import PoseHypothesis
from calib_ros.registration.estimate import insufficient
from calib_ros.registration.features import FeatureExtractor
from calib_ros.registration.initial_guess import MOTION, SEMANTIC, nominal
from calib_ros.registration.judgement.refusal import joined
from calib_ros.registration.motion_guess.guess import motion_guess
from calib_ros.registration.search.constraints import NOMINAL_BOX, SEMANTIC_BOX, SearchBox
from calib_ros.result import InitialSource, Result

# To the best score; a hypothesis near the truth had 0.92 or more (in 75 of 80 sets of 1 to 10 KITTI frames, 68 times first).
MIN_SCORE_RATIO = 0.8
ROUNDS = 4  # of the search around a hypothesis, of which most are wrong: what they do not show, more rounds hardly do


def search_boxes(box: SearchBox) -> tuple[SearchBox, ...]:
    """What is searched around every hypothesis: half the box in two rounds, and the box, where none converged. An empty box is
    refined in once."""
    if box.is_empty:
        return (box,)
    near = np.array_split(box.half_width() / 2, 2)
    (rx, ry, rz), (tx, ty, tz) = np.rad2deg(near[0]).tolist(), near[1].tolist()
    return SearchBox((rx, ry, rz), (tx, ty, tz), 2), replace(box, rounds=box.rounds or ROUNDS)


def best_registration(
    hypotheses: Sequence[PoseHypothesis], estimate: Callable[[Matrix, SearchBox], Result], box: SearchBox = SEMANTIC_BOX
) -> tuple[Result, int]:
    """The result that counts, and how many hypotheses were tried: converged before not, then by score.

    estimate: T_camera_lidar (4, 4) and the box around it -> Result of the registration from there. A hypothesis is tried after
    the first only if it scores nearly as much.
    """
    tried = [h for h in hypotheses if h.score >= MIN_SCORE_RATIO * hypotheses[0].score]
    results: list[Result] = []
    for around in search_boxes(box):
        results += [estimate(h.T, around) for h in tried]
        if any(r.converged for r in results):
            break
    return better(results), len(tried)


def better(results: Sequence[Result]) -> Result:
    """The result that counts: converged before not, then by score."""
    return max(results, key=lambda r: (r.converged, np.nan_to_num(r.score, nan=-np.inf)))


Register = Callable[[Matrix | str, SearchBox | None], Result]  # an initial extrinsic (4, 4) or the name of a guess, and its box


def from_motion(
    register: Register, frames: int, consecutive: Sequence[Frame], extract: FeatureExtractor, box: SearchBox | None
) -> Result:
    """Registers so many frames from the hypotheses of the motion in consecutive ones. box: None = as the guess proposes. Raises
    MissingDependencyError as `motion_guess`."""
    try:
        guess = motion_guess(consecutive, extract, extract.config.search.seed)
    except TooFewFeaturesError as error:
        return insufficient(error, nominal(), frames)
    hypotheses = [PoseHypothesis(T, 1.0, 0.0, MOTION, 0) for T in guess.hypotheses]
    result, _ = best_registration(hypotheses, register, box or guess.box)
    return replace(result, reason=joined([result.reason, guess.note]), origin=InitialSource.MOTION)


def from_anything(
    register: Register, frames: int, consecutive: Sequence[Frame], extract: FeatureExtractor, box: SearchBox | None, classes: bool
) -> Result:
    """The first that converges from motion, from classes where there are some, and from the nominal extrinsic; else the best."""
    tried = {}
    try:
        tried[MOTION] = from_motion(register, frames, consecutive, extract, box)
    except (BadInputError, MissingDependencyError) as error:
        tried[MOTION] = insufficient(error, nominal(), frames)
    if not tried[MOTION].converged and classes:
        tried[SEMANTIC] = register(SEMANTIC, box)
    if not any(result.converged for result in tried.values()):
        tried["nominal"] = replace(register(nominal(), box or NOMINAL_BOX), origin=InitialSource.NOMINAL)
    best = better(list(tried.values()))
    others = [f"not by {name}: {result.reason}" for name, result in tried.items() if result is not best]
    return replace(best, reason=joined([best.reason, *others]))

"""One standard of evidence for every explanation of what the scenes show.

The extrinsic is as given; or off; or something was mixed up, or another camera took the pictures. Any two are compared at the
optimum of each: the difference of their scores over the noise of the score is a log-likelihood ratio, and has to outweigh how
rare the better one is in advance. An explanation under which a scene is symmetric matches as well, and outweighs nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from calib_ros.arrays import Transform
from calib_ros.registration.covariance import (
    REGIONS,
    USUAL_CELLS,
    disagreement,
    effective_frames,
    effective_points,
    inflation,
    noise_of,
)
from calib_ros.registration.judgement.refusal import GROSSLY
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import unlimited

UNKNOWNS = 6  # of an extrinsic
CONFIDENCE = 0.9  # probability from which a verdict is one
EVEN = 1.0  # prior odds, that an extrinsic which somebody checks is off
INDEPENDENT = 2.0  # frames; one scene alone does not tell noise from what is wrong in it


@dataclass(frozen=True, eq=False)
class Match:
    """An explanation at its optimum T (4, 4), with the score of the frames as they look if it holds."""

    score: PointScore
    T: Transform


def freedom(score: PointScore) -> float:
    """Degrees of freedom of the noise of a score: the regions of all frames that show different places, with those that the usual
    noise counts for, less the unknowns."""
    return REGIONS * effective_frames(score) + USUAL_CELLS - UNKNOWNS - 1


def shows_noise(score: PointScore) -> bool:
    """Whether there are scenes enough to tell noise from what is wrong in one of them."""
    return effective_frames(score) >= INDEPENDENT


def shows_lens(score: PointScore) -> bool:
    """Whether intrinsics can be judged: by several scenes, one may gain much by chance, and not on unrolled pictures, where a
    shift is a rotation and lenses of another focal length are unrolled otherwise."""
    return shows_noise(score) and not score.camera.is_sphere


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

"""Guesses of the extrinsic, tried by the registration: the best of what comes out counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.classes import Hypothesis
from calib_ros.registration.search.constraints import SEMANTIC_BOX, SearchBox
from calib_ros.result import Result

Matrix = NDArray[np.float64]
# To the best score; a hypothesis near the truth had 0.92 or more (in 75 of 80 sets of 1 to 10 KITTI frames, 68 times first).
MIN_SCORE_RATIO = 0.8
ROUNDS = 4  # of the search around a hypothesis, of which most are wrong: what they do not show, more rounds hardly do


def worth_trying(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best hypothesis and those that score nearly as much."""
    return [h for h in hypotheses if h.score >= MIN_SCORE_RATIO * hypotheses[0].score]


def search_boxes(box: SearchBox) -> tuple[SearchBox, ...]:
    """What is searched around every hypothesis: half the box in two rounds, and the box, where none converged. An empty box is
    refined in once."""
    if box.is_empty:
        return (box,)
    near = np.array_split(box.half_width() / 2, 2)
    (rx, ry, rz), (tx, ty, tz) = np.rad2deg(near[0]).tolist(), near[1].tolist()
    return SearchBox((rx, ry, rz), (tx, ty, tz), 2), replace(box, rounds=box.rounds or ROUNDS)


def best_registration(
    hypotheses: Sequence[Hypothesis], estimate: Callable[[Matrix, SearchBox], Result], box: SearchBox = SEMANTIC_BOX
) -> tuple[Result, int]:
    """The result that counts, and how many hypotheses were tried: converged before not, then by score.

    estimate: T_camera_lidar (4, 4) and the box around it -> Result of the registration from there. A hypothesis is tried after
    the first only if it is worth trying.
    """
    tried = worth_trying(hypotheses)
    results: list[Result] = []
    for around in search_boxes(box):
        results += [estimate(h.T, around) for h in tried]
        if any(r.converged for r in results):
            break
    return better(results), len(tried)


def better(results: Sequence[Result]) -> Result:
    """The result that counts: converged before not, then by score."""
    return max(results, key=lambda r: (r.converged, np.nan_to_num(r.score, nan=-np.inf)))

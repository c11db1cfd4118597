"""Which of the hypotheses the registration is tried from, and which of its results counts."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from calib_ros.registration.first_guess.guess import Hypothesis
from calib_ros.registration.search_box import SearchBox
from calib_ros.result import Result

WORTH = 0.7  # of the best score; where a right one was among them, it had 0.73 or more (72 trials of 1 to 10 frames, 4 not first)
# Around a hypothesis. With 20 % of all labels wrong and 30 % missing the best of 10 frames was 5 to 8 deg off in 3 of 16 sets: a
# box of 5 deg then led to the truth in 15 of the 16, this one in all.
BOX = SearchBox(8.0, 0.8)


def worth_trying(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best hypothesis and those that score nearly as much."""
    return [h for h in hypotheses if h.score >= WORTH * hypotheses[0].score]


def chosen(hypotheses: Sequence[Hypothesis], estimate: Callable[[NDArray[np.float64]], Result]) -> tuple[Result, int]:
    """The result that counts, and how many hypotheses were tried: converged before not, then by score.

    estimate: T_camera_lidar (4, 4) -> Result of the registration from there. A hypothesis is tried after the first only if
    it is worth trying.
    """
    results = [estimate(h.T) for h in worth_trying(hypotheses)]
    return max(results, key=lambda r: (r.converged, np.nan_to_num(r.score, nan=-np.inf))), len(results)

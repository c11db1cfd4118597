"""Results of an evaluation: the table of trials, and what other experiments measured. Tables and plots need nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from calib_ros_evaluation.curves import Curves

Matrix = NDArray[np.float64]
SUCCESS_DEG, SUCCESS_M = 0.5, 0.1  # a trial that ends nearer than both to the reference has found it
SET = 3  # frames whose curves are averaged, as in figure 4.16
THESIS_THRESHOLD = 0.7  # of similarity (section 3.6)
# What makes a trial the same in two evaluations, which are compared trial by trial. frames: positions in the scene, "0 4 8".
# start_deg, start_m: half width per axis of the start error.
IDENTITY = ("experiment", "method", "scene", "frames", "start_deg", "start_m", "seed")
STATUSES = ("done", "refused", "failed")  # refused: by the method itself: it then ends where it started; failed: with an error
TWIST_AXES = ("rx_deg", "ry_deg", "rz_deg", "tx_m", "ty_m", "tz_m")
END, START = ([f"{name}_{axis}" for axis in TWIST_AXES] for name in ("end", "start"))  # twists log(T T_ref^-1)
SCORES = ("score_start", "score_end", "score_reference")  # by the method's own score; NaN where there is none
# Of the table of trials: a row for each calibration from a wrong start. Errors are those of eq. 2.19, cpu_s is without features.
COLUMNS = (
    *IDENTITY,
    *("status", "reason", "success", "rotation_deg", "translation_m", "start_rotation_deg", "start_translation_m"),
    *(*END, *START, *SCORES, "evaluations", "cpu_s", "features_cpu_s"),
)


def trials_table(rows: Sequence[Mapping[str, Any]], limit_deg: float = SUCCESS_DEG, limit_m: float = SUCCESS_M) -> pd.DataFrame:
    """Rows with COLUMNS as a table. success: done, and within the limits of the reference. A refused trial stays at its start,
    which is no success even where it happens to be near."""
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    near = (table.rotation_deg < limit_deg) & (table.translation_m < limit_m)
    return table.assign(success=((table.status == "done") & near).astype(int))


class CurveResult(NamedTuple):
    """Loss curves of a method around the reference on one set of frames (figures 4.7, 4.10, 4.13). label: of the scene, for
    people."""

    method: str
    label: str
    curves: Curves


@dataclass(frozen=True, eq=False)
class Averaging:
    """Curves of n single frames, to be averaged by eq. 3.16 (figure 4.16). weights: (n,) w_j. shares: (n, 10) of each class among
    the pixels that have one (figures 4.5, 4.8, 4.11). classes_of: where these come from, for people."""

    method: str
    scene: str
    names: tuple[str, ...]
    weights: Matrix
    shares: Matrix
    single: tuple[Curves, ...]
    classes_of: str

    @property
    def shown(self) -> list[int]:
        """SET of the frames: the least, the middle and the most important one."""
        order = np.argsort(self.weights, kind="stable")
        return [int(order[k]) for k in (0, len(order) // 2, -1)]

    def average(self, frames: Sequence[int], weighted: bool) -> Curves:
        """Eq. 3.16: J is linear in the frames' J_j, and so are its curves. Weights that are all 0 count as alike."""
        w = self.weights[list(frames)]
        values = np.average([self.single[k].values for k in frames], axis=0, weights=w if weighted and w.any() else None)
        return Curves(self.single[0].offsets, values)


@dataclass(frozen=True, eq=False)
class Similarity:
    """How alike frames of a scene are (figures 3.22, 3.23). frames: positions (n,) in the scene. matrix: (n, n) rho of eq. 3.15.
    threshold: the configured one. histograms: position -> (channels, bins) shares of pixels by brightness, of some frames."""

    scene: str
    frames: tuple[int, ...]
    matrix: Matrix
    threshold: float
    histograms: dict[int, Matrix]

    @property
    def keyframes(self) -> dict[float, list[int]]:
        """Rows that algorithm 6 selects at the thesis's threshold and at the configured one."""
        return {threshold: algorithm_6(self.matrix, threshold) for threshold in sorted({THESIS_THRESHOLD, self.threshold})}


def algorithm_6(matrix: Matrix, threshold: float) -> list[int]:
    """Rows of similarities (n, n) that algorithm 6 selects: the first, then each below the threshold to the one before."""
    chosen = [0]
    for k in range(1, len(matrix)):
        if matrix[chosen[-1], k] < threshold:
            chosen.append(k)
    return chosen


class Cost(NamedTuple):
    """What a method costs on so many frames, CPU time of one core. memory_mb: most that arrays took while features were made and
    the score was evaluated."""

    method: str
    frames: int
    features_ms_per_frame: float
    evaluation_ms: float
    memory_mb: float


class Trust(NamedTuple):
    """F_C of Levinson and Thrun on one frame, the share of neighbours that score worse. right: at the reference. wrong: (deg, m,
    F_C) of extrinsics that are off by so much."""

    right: float
    wrong: Sequence[Sequence[float]]


@dataclass(frozen=True)
class Results:
    """All that an evaluation found, in the order of its plan. titles: method name -> for people, in the order to be shown."""

    titles: dict[str, str]
    trials: pd.DataFrame = field(default_factory=lambda: trials_table([]))
    curves: Sequence[CurveResult] = ()
    costs: Sequence[Cost] = ()
    failures: Sequence[tuple[str, str]] = ()  # what other job failed, and why
    trusts: Sequence[Trust] = ()
    averagings: Sequence[Averaging] = ()
    similarities: Sequence[Similarity] = ()

"""Results of an evaluation: the table of trials, and what other experiments measured. Tables and plots need nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros_evaluation.curves import Curves

Matrix = NDArray[np.float64]
SUCCESS_DEG, SUCCESS_M = 0.5, 0.1  # a trial that ends nearer than both to the reference has found it
SET = 3  # frames whose curves are averaged, as in figure 4.16
THESIS_THRESHOLD = 0.7  # of similarity (section 3.6)
# What makes a trial the same in two evaluations, which are compared trial by trial.
IDENTITY = ("experiment", "method", "scene", "frames", "start_deg", "start_m", "seed")
TWIST_AXES = ("rx_deg", "ry_deg", "rz_deg", "tx_m", "ty_m", "tz_m")


@dataclass(frozen=True)
class Trial:
    """One calibration from a wrong start: a row of the table of trials, whose columns (see COLUMNS) are these fields in order.

    A twist has a column for each axis, and `success` follows `reason`.
    """

    experiment: str
    method: str
    scene: str
    frames: tuple[int, ...]  # positions in the scene
    start_deg: float  # half width per axis of the start error
    start_m: float
    seed: int
    status: str  # done, refused (by the method itself: it then ends where it started) or failed (with an error)
    reason: str
    rotation_deg: float  # eq. 2.19 at the end
    translation_m: float
    start_rotation_deg: float  # the same at the start
    start_translation_m: float
    end: tuple[float, ...]  # twist (6,) log(T_end T_ref^-1), deg and m
    start: tuple[float, ...]  # twist (6,) of the start
    score_start: float  # by the method's own score; NaN where there is none
    score_end: float
    score_reference: float
    evaluations: int
    cpu_s: float  # of the optimisation, without features
    features_cpu_s: float  # of all its frames

    @property
    def success(self) -> bool:
        """Done, and within SUCCESS_DEG and SUCCESS_M of the reference. A refused trial stays at its start, which is no success
        even where it happens to be near."""
        return self.status == "done" and self.rotation_deg < SUCCESS_DEG and self.translation_m < SUCCESS_M

    @property
    def start_success(self) -> bool:
        """The start itself is within SUCCESS_DEG and SUCCESS_M."""
        return self.start_rotation_deg < SUCCESS_DEG and self.start_translation_m < SUCCESS_M

    @property
    def identity(self) -> tuple[object, ...]:
        """Values of IDENTITY."""
        return tuple(getattr(self, name) for name in IDENTITY)

    def row(self) -> list[Any]:
        """Values of COLUMNS."""
        values: list[Any] = []
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            values += value if name in TWISTS else [" ".join(map(str, value)) if name == "frames" else value]
            values += [int(self.success)] if name == "reason" else []
        return values


TWISTS = ("end", "start")


def _columns() -> tuple[str, ...]:
    names: list[str] = []
    for name in (field.name for field in fields(Trial)):
        names += [f"{name}_{axis}" for axis in TWIST_AXES] if name in TWISTS else [name]
        names += ["success"] if name == "reason" else []
    return tuple(names)


COLUMNS = _columns()


@dataclass(frozen=True, eq=False)
class CurveResult:
    """Loss curves of a method around the reference on one set of frames (figures 4.7, 4.10, 4.13). label: of the scene, for
    people."""

    experiment: str
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


@dataclass(frozen=True)
class Cost:
    """What a method costs on one scene, CPU time of one core. memory_mb: most that arrays took while features were made and the
    score was evaluated."""

    method: str
    scene: str
    frames: int
    features_ms_per_frame: float
    evaluation_ms: float
    memory_mb: float


@dataclass(frozen=True)
class Trust:
    """F_C of Levinson and Thrun on one frame, the share of neighbours that score worse. right: at the reference. wrong: (deg, m,
    F_C) of extrinsics that are off by so much."""

    scene: str
    right: float
    wrong: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Results:
    """All that an evaluation found, in the order of its plan. titles: method name -> for people, in the order to be shown."""

    titles: dict[str, str]
    trials: Sequence[Trial] = ()
    curves: Sequence[CurveResult] = ()
    costs: Sequence[Cost] = ()
    failures: Sequence[tuple[str, str]] = ()  # what other job failed, and why
    trusts: Sequence[Trust] = ()
    averagings: Sequence[Averaging] = ()
    similarities: Sequence[Similarity] = ()

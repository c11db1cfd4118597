"""Results of an evaluation: the table of trials, and what other experiments measured. Tables and plots need nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros_evaluation.curves import Curves

Matrix = NDArray[np.float64]
SUCCESS_DEG, SUCCESS_M = 0.5, 0.1  # a trial that ends nearer than both to the reference has found it
# What makes a trial the same in two evaluations, which are compared trial by trial.
IDENTITY = ("experiment", "method", "scene", "frames", "start_deg", "start_m", "seed")
TWIST_AXES = ("rx_deg", "ry_deg", "rz_deg", "tx_m", "ty_m", "tz_m")


@dataclass(frozen=True)
class Trial:
    """One calibration from a wrong start: a row of the table of trials, whose columns (see COLUMNS) are these fields in order.

    A twist has a column for each axis, and `success` follows `reason`; the trace is in no column.
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
    # (n, 4) evaluations, CPU s, rotation error deg, translation error m of the best by the score; empty if not kept.
    trace: tuple[tuple[float, ...], ...] = ()

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

    def extrinsic(self, reference: Matrix) -> Matrix:
        """T_camera_lidar (4, 4) at the end, given the reference (4, 4)."""
        return se3.exp([*np.deg2rad(self.end[:3]), *self.end[3:]]) @ reference

    def row(self) -> list[Any]:
        """Values of COLUMNS."""
        values: list[Any] = []
        for name in (field.name for field in fields(self) if field.name != "trace"):
            value = getattr(self, name)
            values += value if name in TWISTS else [" ".join(map(str, value)) if name == "frames" else value]
            values += [int(self.success)] if name == "reason" else []
        return values


TWISTS = ("end", "start")


def _columns() -> tuple[str, ...]:
    names: list[str] = []
    for name in (field.name for field in fields(Trial) if field.name != "trace"):
        names += [f"{name}_{axis}" for axis in TWIST_AXES] if name in TWISTS else [name]
        names += ["success"] if name == "reason" else []
    return tuple(names)


COLUMNS = _columns()


@dataclass(frozen=True, eq=False)
class CurveResult:
    """Loss curves of a method around the reference on one set of frames (figures 4.7, 4.10, 4.13, 4.16). label: of the scene,
    for people."""

    experiment: str
    method: str
    label: str
    curves: Curves


@dataclass(frozen=True, eq=False)
class HeatMap:
    """Scores of a method over two axes around the reference (figures 3.17, 3.18). axes: numbers of the two among AXES. x, y: (n,)
    offsets along them, deg or cm. values: (len(y), len(x))."""

    method: str
    label: str
    axes: tuple[int, int]
    x: Matrix
    y: Matrix
    values: Matrix


@dataclass(frozen=True, eq=False)
class Similarity:
    """Histogram similarity of the frames of a scene (figures 3.22, 3.23). names: of the frames. stamps: (n,) s since the first.
    matrix: (n, n) rho of eq. 3.15. keyframes: threshold -> positions that algorithm 6 selects, as the thesis has it. online:
    positions that the node's selection takes. histograms: frame name -> (channels, 64) shares of a few frames."""

    scene: str
    names: tuple[str, ...]
    stamps: Matrix
    matrix: Matrix
    keyframes: dict[float, tuple[int, ...]]
    online: tuple[int, ...]
    online_threshold: float
    histograms: dict[str, Matrix]


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


@dataclass(frozen=True, eq=False)
class Averaging:
    """Weighted against unweighted averaging (figure 4.16). labels: of the frames. weights: (n,) w_j. single: curves of each.
    weighted, unweighted: of all. classes: where w_j come from, for people. distances: (n, 2, 6) of many sets of frames, how far
    the peaks of the weighted [:, 0] and the unweighted [:, 1] average lie from the reference along each axis, deg and cm."""

    method: str
    scene: str
    labels: tuple[str, ...]
    weights: Matrix
    single: tuple[Curves, ...]
    weighted: Curves
    unweighted: Curves
    classes: str
    distances: Matrix


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
    heat_maps: Sequence[HeatMap] = ()
    similarities: Sequence[Similarity] = ()
    costs: Sequence[Cost] = ()
    averagings: Sequence[Averaging] = ()
    failures: Sequence[tuple[str, str]] = ()  # what other job failed, and why
    trusts: Sequence[Trust] = ()

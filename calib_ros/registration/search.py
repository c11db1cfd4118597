"""Global search in a box around the prior: Sobol starts in all six degrees of freedom, successive halving.

Rotation-only grids lose the truth under half a metre of translation; false optima above the truth are rare once edges
are oriented, so that what decides is the number of starts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from calib_ros import se3
from calib_ros.config import SearchConfig
from calib_ros.errors import ConfigError
from calib_ros.registration.optimizers import Prior, levenberg_marquardt, nelder_mead
from calib_ros.registration.point_score import PointScore

Matrix = NDArray[np.float64]
PRIOR_STRENGTH = 0.03  # of the score at one box half width: keeps weak directions inside the box, does not move strong ones
BOX_STRENGTH = 2.0  # penalty per squared half width beyond 110 % of the box
SAME_START = 0.12  # of the half width: starts nearer than this on all axes count as one
SAME_OPTIMUM_DEG = 0.5  # optima nearer than this (10 cm count as 0.5 deg) count as one
SIMPLEX_DEG = (0.8, 0.4)  # first simplex on the middle levels


@dataclass(frozen=True)
class SearchBox:
    """Half widths of the search per axis, around the initial extrinsic, in the camera frame. Zero = refine only."""

    rotation_deg: float = 10.0
    translation_m: float = 0.5

    def __post_init__(self) -> None:
        for name, value, high in (("rotation_deg", self.rotation_deg, 45.0), ("translation_m", self.translation_m, 3.0)):
            if not 0 <= value <= high:
                raise ConfigError(f"SearchBox.{name} = {value!r} is out of range [0, {high:g}]")

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to search."""
        return self.rotation_deg == 0 and self.translation_m == 0

    def half_width(self) -> Matrix:
        """(6,) in rad and m; an axis that is not searched keeps a hair's breadth."""
        return np.repeat([max(np.deg2rad(self.rotation_deg), 1e-4), max(self.translation_m, 1e-3)], 3)


def search(
    score: PointScore, T_prior: Matrix, box: SearchBox, config: SearchConfig, progress: Callable[[float], None] | None = None
) -> Matrix:
    """The best extrinsic (4, 4) in the box by the score's second finest level; to be refined on the finest one.

    progress: called with 0..1. Deterministic for a given config.seed.
    """
    report = progress or (lambda share: None)
    rng = np.random.default_rng(config.seed)
    coarse, middle = score.subset(config.coarse_points, rng), score.subset(config.middle_points, rng)
    half = box.half_width()
    inverse_prior = se3.inverse(T_prior)
    prior = Prior(T_prior, PRIOR_STRENGTH / half**2)

    def outside(T: Matrix) -> float:
        excess = np.maximum(np.abs(se3.log(T @ inverse_prior)) / half - 1.1, 0)
        return BOX_STRENGTH * float(excess @ excess)

    starts = _starts(config, half, T_prior, coarse, lambda share: report(0.15 * share))
    optima = []
    for k, T in enumerate(starts):
        for level in (0, 1):
            T, _ = levenberg_marquardt(coarse.at(level), T, 8, prior)
        optima.append((coarse.at(1).value(T) - outside(T), T))
        report(0.15 + 0.45 * (k + 1) / len(starts))
    refined = []
    candidates = _distinct(optima, config.refined)
    for k, T in enumerate(candidates):
        for level, step in zip((1, 2), SIMPLEX_DEG, strict=True):
            T, value = nelder_mead(middle.at(level), T, step, config.simplex_evaluations, outside)
        refined.append((value, T))
        report(0.6 + 0.3 * (k + 1) / len(candidates))
    refined.sort(key=lambda x: -x[0])
    final = []
    for _, T in refined[: config.finalists]:
        T, value = levenberg_marquardt(score.at(2), T)
        final.append((value - outside(T), T))
    report(1.0)
    return max(final, key=lambda x: x[0])[1]


def _starts(
    config: SearchConfig, half: Matrix, T_prior: Matrix, coarse: PointScore, report: Callable[[float], None]
) -> list[Matrix]:
    """The best starts that differ, the prior itself among the candidates."""
    n = 1 << (config.starts - 1).bit_length()  # Sobol sequences are balanced at powers of two only
    unit = np.vstack([np.zeros(6), qmc.Sobol(6, seed=config.seed).random(n)[: config.starts] * 2 - 1])
    level = coarse.at(0)
    scores = np.empty(len(unit))
    for k, x in enumerate(unit):
        scores[k] = level.value(se3.exp(x * half) @ T_prior)
        if k % 256 == 0:
            report(k / len(unit))
    picked: list[int] = []
    for k in np.argsort(-scores, kind="stable"):
        if not picked or (np.abs(unit[k] - unit[picked]).max(axis=1) > SAME_START).all():
            picked.append(int(k))
            if len(picked) == config.distinct:
                break
    return [se3.exp(unit[k] * half) @ T_prior for k in picked]


def _distinct(optima: list[tuple[float, Matrix]], count: int) -> list[Matrix]:
    """The best `count` optima, best first, near duplicates left out."""
    picked: list[Matrix] = []
    for _, T in sorted(optima, key=lambda x: -x[0]):
        gaps = [se3.log(T @ se3.inverse(S)) for S in picked]
        if all(np.linalg.norm(np.concatenate([np.rad2deg(g[:3]), 5 * g[3:]])) > SAME_OPTIMUM_DEG for g in gaps):
            picked.append(T)
            if len(picked) == count:
                break
    return picked

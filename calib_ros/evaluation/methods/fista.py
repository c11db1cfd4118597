"""Accelerated gradient ascent (FISTA; Beck and Teboulle 2009) of a score over the extrinsic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.registration.optimizers import AXES, LEVEL
from calib_ros.registration.scores import Score

Matrix = NDArray[np.float64]
GROWTH = 2.0  # of the step length before every iteration: the score is steeper here and flatter there
# Share of what the slope promises that a step must gain. Beck and Teboulle's quadratic bound asks for half, but the slopes of a
# score that counts pixels promise too much: with a tenth, on one scale, 58 % of 12 KITTI frames end within 0.5 deg and 15 cm
# instead of 42 %.
GAIN = 0.1
WIDEST = 0.25  # of the box; half width of the first differences. From an eighth most runs end on the first ripple
SHORT = 0.25  # of that half width; a shorter step says that the slope is of something narrower


def fista(
    score: Score, T: Matrix, half_width: Matrix, finest_deg: float, evaluations: int, begin: Matrix | None = None
) -> tuple[Matrix, float]:
    """The best extrinsic (4, 4) seen by accelerated ascent from `begin`, or T, and its score.

    It stays in the box of twists of half_width (6,) rad and m around T; a step onto its walls is the proximal one. Every step
    follows the slope at a point y beyond the last one, by t_k = (1 + sqrt(1 + 4 t_(k-1)^2)) / 2, and is halved until it gains
    enough. When the score falls, the acceleration starts anew from the best (O'Donoghue and Candes 2015). The slope is taken
    by central differences, half as wide whenever nothing more is gained, down to finest_deg (and what METRES_PER_RADIAN makes
    of it). Ends there, or when the next iteration might need more than `evaluations`.
    """
    box, finest = half_width / AXES, np.deg2rad(finest_deg)
    axes, used = np.eye(6)[box > 0], 0

    x = np.zeros(6) if begin is None else np.clip(se3.log(begin @ se3.inverse(T)) / AXES, -box, box)
    best, highest = x, -np.inf

    def value(x: Matrix) -> float:
        nonlocal used, best, highest
        used += 1
        found = score.value(se3.exp(x * AXES) @ T)
        if found > highest and (np.abs(x) <= box).all():  # differences are taken across its walls, too
            best, highest = x, found
        return found

    here = value(x)
    y, at_y, t, rate = x, here, 1.0, np.inf
    epsilon, longest = max(WIDEST * box.max(), finest), 0.5 * box.max()
    while used + 2 * len(axes) + 2 <= evaluations and len(axes):
        slope = np.zeros(6)
        for axis in axes:
            slope += axis * (value(y + epsilon * axis) - value(y - epsilon * axis)) / (2 * epsilon)
        steepness = float(np.linalg.norm(slope))
        if not steepness > LEVEL:  # NaN, too
            break
        rate = min(GROWTH * rate, longest / steepness)
        while True:
            new = np.clip(y + rate * slope, -box, box)
            moved, there = new - y, value(new)
            if there >= at_y + GAIN * float(slope @ moved) or rate * steepness < SHORT * epsilon or used >= evaluations:
                break
            rate /= 2
        short = bool(np.abs(moved).max() < SHORT * epsilon)
        if short or there <= here:
            if short or t == 1:
                if epsilon <= finest:
                    break
                epsilon, rate = max(epsilon / 2, finest), np.inf
            x = y = best
            here, at_y, t = highest, highest, 1.0
            continue
        following = (1 + np.sqrt(1 + 4 * t * t)) / 2
        y = np.clip(new + (t - 1) / following * (new - x), -box, box)
        x, here, t = new, there, following
        at_y = here if np.array_equal(y, x) else value(y)
    return np.asarray(se3.exp(best * AXES) @ T), highest

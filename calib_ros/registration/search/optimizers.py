"""Optimisers of a score over the extrinsic. All maximise, start at T and return (T, score)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.registration.score.point_score import PointScore, Score, SmoothScore
from calib_ros.registration.search.constraints import Limits, Prior, unlimited

JOINT_ITERATIONS, GAIN = 15, 1e-7  # per level; a step that gains less of the score is rounding
LEVEL = 1e-9  # score per radian; a slope below is rounding, and no way up
METRES_PER_RADIAN = 10.0  # 1 deg moves an edge at 10 m as far as 17 cm: steps along all axes then weigh alike
AXES = np.array([1.0, 1, 1, *[METRES_PER_RADIAN] * 3])  # what one radian is along each axis of a twist

# Of `refined`, for values of an unknown that are far off: 3 % of the focal length move the extrinsic by 3 deg and 40 cm; REACH is
# twice as far. And for those nearby.
POINTS, LEVELS, TOLERANCE_DEG = 6000, (1, 2, 3, 4), 0.01
REACH = np.array([np.deg2rad(6.0)] * 3 + [0.8] * 3)  # rad, m
NEAR_POINTS, NEAR_LEVELS, NEAR_TOLERANCE_DEG = 4000, (3, 4), 0.003


def levenberg_marquardt(
    score: SmoothScore,
    T: Transform,
    iterations: int = 20,
    prior: Prior | None = None,
    limits: Limits | None = None,
    tolerance_deg: float = 0.001,
    near: bool = False,
) -> tuple[Matrix, float]:
    """Damped Gauss-Newton ascent on left twists; the score less the prior's cost never falls. Returns T (4, 4) and the score
    without the prior.

    near: T is a few degrees from the optimum, and the curvature is learned from the change of the slope along every step: 3 to 7
    iterations instead of 10 to 15; from afar its steps reach out of a search's box. Stops after `iterations`, when no damped step
    improves, or when a step falls below tolerance_deg (0.3 mm at 0.001 deg).
    """
    limits = limits or unlimited(T)
    damping, T = 1e-2, limits.clip(T)
    cost, slope = prior.cost(T) if prior else (0.0, np.zeros(6))
    best = score.value(T)
    objective = best - cost
    H, last, moved = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for n in range(iterations):
        ascent, scale = score.linearise(T)
        H = learned_curvature(H, moved, last - ascent) if near and n else scale
        gradient, B = ascent - slope, H
        if prior:
            B = H + np.diag(prior.information)
        axes = np.flatnonzero(limits.movable(T, gradient))
        gradient, B, step = gradient[axes], B[np.ix_(axes, axes)], np.zeros(6)
        steep, damped = B.diagonal(), B.copy()
        for _ in range(6):
            damped.flat[:: len(axes) + 1] = steep + (damping * steep + 1e-9)
            step[axes] = np.linalg.solve(damped, gradient)
            candidate = limits.clip(se3.exp(step) @ T)
            value = score.value(candidate)
            new_cost, new_slope = prior.cost(candidate) if prior else (0.0, slope)
            if value - new_cost > objective + GAIN:
                break
            damping = max(damping * 6, 1e-3)
        else:
            break
        moved, last = se3.log(candidate @ se3.inverse(T)) if near else moved, ascent
        T, best, objective, slope = candidate, value, value - new_cost, new_slope
        damping /= 4
        if np.abs(step[:3]).max() < 0.02 * tolerance_deg and np.abs(step[3:]).max() < 0.3 * tolerance_deg:
            break
    return T, best


def learned_curvature(H: Matrix, moved: Matrix, fell: Matrix) -> Matrix:
    """The update of a curvature (k, k) by Broyden, Fletcher, Goldfarb and Shanno: along the step `moved` (k,) the slope fell by
    `fell` (k,). Unchanged where that is no descent, which would make it indefinite."""
    along, product = H @ moved, float(moved @ fell)
    expected = float(moved @ along)
    if not product > 1e-3 * expected > 0:
        return H
    return H - np.outer(along, along) / expected + np.outer(fell, fell) / product


def refined(
    score: PointScore, T: Transform, limits: Limits, levels: tuple[int, ...], tolerance_deg: float
) -> tuple[Matrix, float]:
    """The optimum (4, 4) near T and its score, level by level."""
    T, value = limits.clip(T), 0.0
    for level in levels:
        T, value = levenberg_marquardt(score.at(level), T, limits=limits, tolerance_deg=tolerance_deg, near=True)
    return T, value


# A score at values of n further unknowns, the extrinsic (4, 4) it is seen from, and the slopes (n, points) by the unknowns from
# those (6, points) by a left twist.
JointView = tuple[PointScore, Transform, Callable[[NDArray[np.float32]], Matrix | NDArray[np.float32]]]


def linearised(view: JointView, n: int, level: int) -> tuple[Matrix, Matrix]:
    """Gradient (6 + n,) of the score by a left twist and by the unknowns, and a positive matrix that scales the step."""
    J = joint_jacobian(view, n, level)
    weighted = J * view[0].weights
    return weighted.sum(axis=1, dtype=np.float64), (weighted @ J.T).astype(np.float64)


def joint_jacobian(view: JointView, n: int, level: int) -> NDArray[np.float32]:
    """Slopes (6 + n, points) of the points' values, by a left twist and by the unknowns."""
    score, T, slopes = view
    J = np.empty((6 + n, score.points.shape[1]), np.float32)
    J[:6] = score.jacobian(T, level)
    J[6:] = slopes(J[:6])
    return J


def ascend_jointly(
    see: Callable[[Transform, Matrix], JointView],
    T: Transform,
    x: Matrix,
    levels: Sequence[int],
    limits: Limits,
    prior: Prior | None = None,
    free: NDArray[np.bool_] | None = None,
) -> tuple[Matrix, Matrix, float]:
    """The optimum of the extrinsic and n more unknowns near T (4, 4) and x (n,), level by level: damped Gauss-Newton steps as in
    `levenberg_marquardt`, whose curvature is learnt on the way.

    free: (n,) which of x may change; None = all. Returns T, x and the score, the cost of the prior not subtracted.
    """
    n, of_x = len(x), np.ones(len(x), bool) if free is None else free
    for level in levels:
        here = see(T, x)
        best = here[0].at(level).value(here[1])
        objective = best - (prior.cost(T)[0] if prior else 0.0)
        damping, H, last, step = 1e-2, np.zeros((6 + n, 6 + n)), np.zeros(6 + n), np.zeros(6 + n)
        for k in range(JOINT_ITERATIONS):
            ascent, scale = linearised(here, n, level)
            H = learned_curvature(H, step, last - ascent) if k else scale
            gradient, B = ascent.copy(), H.copy()
            if prior:
                gradient[:6] -= prior.cost(T)[1]
                B[:6, :6] += np.diag(prior.information)
            axes = np.flatnonzero(np.r_[limits.movable(T, gradient[:6]), of_x])
            for _ in range(6):
                step = np.zeros(6 + n)
                damped = B[np.ix_(axes, axes)] + np.diag(damping * np.diag(B)[axes] + 1e-9)
                step[axes] = np.linalg.solve(damped, gradient[axes])
                candidate, later = limits.clip(se3.exp(step[:6]) @ T), x + step[6:]
                moved = see(candidate, later)
                value = moved[0].at(level).value(moved[1])
                higher = value - (prior.cost(candidate)[0] if prior else 0.0)
                if higher > objective + GAIN:
                    break
                damping = max(damping * 6, 1e-3)
            else:
                break
            T, x, here, best, objective, last = candidate, later, moved, value, higher, ascent
            damping /= 4
            if np.abs(step[6:]).max() < 1e-5 and np.abs(step[:3]).max() < 2e-6 and np.abs(step[3:6]).max() < 2e-5:
                break
    return T, x, best


def nelder_mead(
    score: Score,
    T: Transform,
    step_deg: float = 0.8,
    evaluations: int = 120,
    penalty: Callable[[Matrix], float] | None = None,
    limits: Limits | None = None,
    tolerances: tuple[float, float] = (0.02, 1e-5),
) -> tuple[Matrix, float]:
    """Downhill simplex (thesis 3.4.4, figure 3.19) on left twists; robust where the slope misleads.

    step_deg: size of the first simplex in rotation, deg; in translation METRES_PER_RADIAN times that. penalty: subtracted
    from the score. tolerances: share of its first size, and difference of scores, at which it ends. Returns the better of start
    and optimum, and the score less the penalty.
    """
    limits = limits or unlimited(T)
    T = limits.clip(T)
    axes = (np.deg2rad(step_deg) * np.diag(AXES))[limits.open_axes]
    n = len(axes)

    def moved(y: Matrix) -> Matrix:
        return limits.clip(se3.exp(y @ axes) @ T)

    def cost(y: Matrix) -> float:
        X = moved(y)
        return (penalty(X) if penalty else 0.0) - score.value(X)

    start = cost(np.zeros(n))
    if n == 0:
        return T, -start
    # The simplex surrounds the start: one vertex below it on all axes, one above on each.
    simplex = np.vstack([np.zeros(n), np.eye(n)]) - 0.3 / np.sqrt(n)
    x, lowest = _downhill(cost, simplex, evaluations, *tolerances)
    if not lowest < start:  # NaN too
        return T, -start
    return moved(x), -lowest


def _downhill(cost: Callable[[Matrix], float], x: Matrix, evaluations: int, near: float, alike: float) -> tuple[Matrix, float]:
    """The lowest vertex and its cost, from a simplex x (n + 1, n): Nelder and Mead, A simplex method for function minimization,
    1965, as scipy.optimize.minimize, which takes a fifth of a second to import. near, alike: of vertices and costs at the end."""
    left, n = evaluations, x.shape[1]

    def at(point: Matrix) -> float:
        nonlocal left
        if not left:
            raise StopIteration
        left -= 1
        return cost(point)

    f = np.full(n + 1, np.inf)
    with suppress(StopIteration):
        for k in range(n + 1):
            f[k] = at(x[k])
    while True:
        order = np.argsort(f)
        x, f = x[order], f[order]
        if not left or (np.abs(x[1:] - x[0]).max() <= near and np.abs(f[0] - f[1:]).max() <= alike):
            return x[0], float(f[0])
        centre = x[:-1].sum(axis=0) / n
        with suppress(StopIteration):
            reflected = 2 * centre - x[-1]
            value = at(reflected)
            if value < f[0]:
                expanded = 3 * centre - 2 * x[-1]
                further = at(expanded)
                x[-1], f[-1] = (expanded, further) if further < value else (reflected, value)
            elif value < f[-2]:
                x[-1], f[-1] = reflected, value
            else:
                outside = value < f[-1]
                contracted = 1.5 * centre - 0.5 * x[-1] if outside else 0.5 * centre + 0.5 * x[-1]
                nearer = at(contracted)
                if nearer <= value if outside else nearer < f[-1]:
                    x[-1], f[-1] = contracted, nearer
                else:
                    for k in range(1, n + 1):
                        x[k] = x[0] + 0.5 * (x[k] - x[0])
                        f[k] = at(x[k])


def barzilai_borwein(
    score: Score,
    T: Transform,
    step_deg: float = 0.5,
    epsilon_deg: float = 0.1,
    evaluations: int = 240,
    limits: Limits | None = None,
    penalty: Callable[[Matrix], float] | None = None,
) -> tuple[Matrix, float]:
    """Gradient ascent with the step length of Barzilai and Borwein (1988), eq. 3.13 and 3.14 of the thesis.

    epsilon_deg: half width of the central differences, deg (METRES_PER_RADIAN times that in translation). step_deg: first step,
    and the longest one. Steps may lower the score: the best extrinsic seen (4, 4) is returned, with its score less the penalty.
    Ends after `evaluations`, or when a step falls below a twentieth of epsilon.
    """
    epsilon, longest = np.deg2rad(epsilon_deg), np.deg2rad(step_deg)
    limits = limits or unlimited(T)
    T = limits.clip(T)

    def value_at(X: Matrix) -> float:
        return score.value(X) - (penalty(X) if penalty else 0.0)

    here, best, best_value = T, T, value_at(T)
    used, step, gradient = 1, np.zeros(6), np.zeros(6)
    while used + 13 <= evaluations:
        ahead = [value_at(se3.exp(epsilon * AXES * axis) @ here) for axis in np.eye(6)]
        behind = [value_at(se3.exp(-epsilon * AXES * axis) @ here) for axis in np.eye(6)]
        last, gradient = gradient, (np.array(ahead) - np.array(behind)) / (2 * epsilon)
        gradient = np.where(limits.movable(here, gradient), gradient, 0.0)
        used += 12
        steepness = float(np.linalg.norm(gradient))
        if not steepness > LEVEL:  # NaN too
            break
        change = gradient - last
        alpha = abs(float(step @ step) / float(step @ change)) * steepness if step @ change != 0 else longest
        alpha = min(alpha, longest)
        if alpha < epsilon / 20:
            break
        step = alpha * gradient / steepness
        here = limits.clip(se3.exp(step * AXES) @ here)
        value = value_at(here)
        used += 1
        if value > best_value:
            best, best_value = here, value
    return best, best_value

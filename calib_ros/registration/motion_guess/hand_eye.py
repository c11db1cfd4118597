"""The rotation between LiDAR and camera from the LiDAR's known motion and points tracked in the images.

Between two moments the LiDAR's points move by A (4, 4), so the camera's move by X A X^-1, X = T_camera_lidar (the hand-eye
equation, Tsai and Lenz 1989), with R = R_X R_A R_X^T and t = R_X (t_A + (R_A - I) c), c the camera's centre in the LiDAR's frame.
A point seen in direction x at first, at an unknown distance d, is later seen on an arc: R x + t / d, from d = infinity to the
nearest distance at which anything can be. The angle from that arc is the residual, whatever the kind of motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Matrix
from calib_ros.registration.initial_guess import rotation_distance_deg
from calib_ros.registration.motion_guess.tracks import Run, Tracks

NEAREST_M = 0.5  # nothing that can be tracked is nearer
NOISE_PX = 0.3  # of a tracked point, at least
COARSE = 2000  # rotations tried, about 14 deg apart: the cost falls towards the right one from twice as far
COARSE_TRACKS, FINE_TRACKS = 500, 1500
STARTS = 16  # of these, those that are refined
SAME_DEG = 3.0  # rotations nearer than this are one
ROUNDS, LAST_ROUNDS = 12, 20  # steps of Gauss and Newton
STEP, CLOCK_STEP_S = 1e-5, 1e-3  # rad and m, and s, of numerical derivatives
CONVERGED_RAD = 1e-4  # smaller steps are none
MAX_COST_RATIO = 1.3  # to the least of 16 local optima; where only one is right, it costs half as much as the next
CENTRE_M = 1.0  # standard deviation of the camera's place along every axis, around the LiDAR
CLOCK_S = 0.05  # standard deviation of the offset of the clocks, before anything is known of it
CLOCKS_S = np.linspace(-0.5, 0.5, 11)  # offsets tried
# Standard deviations, at first and at least, of the error of the LiDAR's motion between two pictures along every axis.
MOTION_RAD, MOTION_M = np.deg2rad([0.1, 0.02]), np.array([0.03, 0.005])
OVERLAP = 2.0  # pairs of pictures overlap by half, so that every moment counts twice


@dataclass(frozen=True, eq=False)
class Fit:
    """R: (3, 3) of T_camera_lidar. centre: (3,) m of the camera in the LiDAR's frame, as far as known. clock_s: to be added to
    the stamps of images to get moments on the LiDAR's clock. cost: mean robust residual, in units of its scale. scale: rad, of
    the residuals. covariance: (7, 7) of a turn of the camera about its own axes (rad), of the centre (m) and of the clock (s).
    unexplained: median residual of the LiDAR's motion as measured, as a share of how far points moved.
    turn_error: rad, standard deviation of the LiDAR's turn between two pictures about every axis, as the pictures see it.
    """

    R: Matrix
    centre: Matrix
    clock_s: float
    cost: float
    scale: float
    covariance: Matrix
    unexplained: float
    turn_error: float


Errors = Callable[[Matrix], tuple[Matrix, Matrix]]  # steps (m, 6) of the errors that belong to a step (7,), and their variances


class HandEye:
    """The residuals of tracks, whose LiDAR's motion is that of the runs, and the rotations that they have in common."""

    def __init__(self, tracks: Tracks, runs: Sequence[Run], seed: int = 0) -> None:
        self.tracks, self._runs, self._seed = tracks, runs, seed
        self._floor = NOISE_PX * tracks.pixel

    def motions(self, clock_s: float = 0.0) -> Matrix:
        """How the LiDAR's points move from the first to the second moment of every pair (m, 4, 4)."""
        t = self.tracks
        out = np.tile(np.eye(4), (len(t.start), 1, 1))
        for r, run in enumerate(self._runs):
            own = t.run == r
            if own.any():
                out[own] = run.relative(t.start[own] + clock_s, t.end[own] + clock_s)
        return out

    def hypotheses(self, limit: int) -> list[Fit]:
        """Rotations that explain the tracks, best first: local optima of the robust cost over all rotations, at most `limit`."""
        rng = np.random.default_rng(self._seed)
        motions = self.motions()
        scale = max(float(np.median(self._flow(self.tracks))) / 4, self._floor)
        coarse = self.tracks.subset(COARSE_TRACKS, rng)
        rotations = _all_rotations(COARSE)
        costs = np.array([_cost(_residuals(R, np.zeros(3), motions, coarse), scale) for R in rotations])
        starts = [rotations[k] for k in distinct(rotations, costs, 2 * SAME_DEG)]
        fine = self.tracks.subset(FINE_TRACKS, rng)
        refined = np.array([self._turned(R, motions, fine) for R in starts])
        scale = min(_scale(_residuals(R, np.zeros(3), motions, fine), self._floor) for R in refined)
        costs = np.array([_cost(_residuals(R, np.zeros(3), motions, fine), scale) for R in refined])
        plausible = [k for k in distinct(refined, costs, SAME_DEG) if costs[k] <= MAX_COST_RATIO * costs.min()]
        fits = [self.fit(refined[k]) for k in plausible[:limit]]
        smallest = min(fit.scale for fit in fits)
        for k, fit in enumerate(fits):
            r = _residuals(fit.R, fit.centre, self.motions(fit.clock_s), self.tracks)
            fits[k] = replace(fit, cost=_cost(r, smallest))
        order = distinct(np.array([f.R for f in fits]), np.array([f.cost for f in fits]), SAME_DEG)
        return [fits[k] for k in order]

    def fit(self, R: Matrix, upright: tuple[Matrix, float] | None = None) -> Fit:
        """The optimum next to a rotation (3, 3) in rotation, centre, clocks, and the errors of the LiDAR's motion, which are
        eliminated pair by pair (Schur complement). upright: a prior, the LiDAR's z axis (3,) in the camera and its sigma, rad."""
        prior = np.r_[np.zeros(3), np.full(3, CENTRE_M**-2.0), CLOCK_S**-2.0]
        centre, clock, wrong = np.zeros(3), self._clock(R), np.zeros((len(self.tracks.start), 6))
        sigma = np.r_[MOTION_RAD[0], MOTION_M[0]]
        for _ in range(LAST_ROUNDS):
            r, J = self._linear(R, centre, clock, wrong)
            scale = _scale(r, self._floor)
            weight = 1 / (scale**2 + (r * r).sum(axis=1))
            reduced, gradient, errors_at = self._reduced(r, J, weight, wrong, np.repeat(sigma**-2.0, 3))
            information = reduced + np.diag(prior)
            gradient[3:] += prior[3:] * np.r_[centre, clock]
            if upright is not None:
                up, sigma_up = upright  # where the LiDAR's z axis points to in the camera
                d, G = (R[:, 2] - up) / sigma_up, -se3.skew(R[:, 2]) / sigma_up
                information[:3, :3] += G.T @ G
                gradient[:3] += G.T @ d
            step = -np.linalg.solve(information + 1e-6 * np.eye(7), gradient)
            step *= min(1.0, 0.3 / max(float(np.linalg.norm(step[:3])), 1e-9))
            errors, spread = errors_at(step)
            R, centre, wrong = se3.rotation_from_vector(step[:3]) @ R, centre + step[3:6], wrong + errors
            clock = float(np.clip(clock + step[6], CLOCKS_S[0], CLOCKS_S[-1]))
            # As expectation maximisation has it: the spread of the errors found, and what is left open of each.
            found = np.sqrt([np.mean(wrong[:, s] ** 2 + spread[:, s]) for s in (slice(0, 3), slice(3, 6))])
            sigma = np.maximum(found, [MOTION_RAD[1], MOTION_M[1]])
            if np.abs(step[:3]).max() < CONVERGED_RAD:
                break
        covariance = OVERLAP * np.linalg.inv(information + 1e-6 * np.eye(7))
        measured = _residuals(R, centre, self.motions(clock), self.tracks)
        unexplained = float(np.median(np.linalg.norm(measured, axis=1)) / np.median(self._flow(self.tracks)))
        return Fit(R, centre, clock, _cost(r, scale), scale, covariance, unexplained, float(sigma[0]))

    def _reduced(self, r: Matrix, J: Matrix, weight: Matrix, errors: Matrix, precision: Matrix) -> tuple[Matrix, Matrix, Errors]:
        """Normal equations of residuals r (n, 2), J (n, 2, 13), without the errors (m, 6) of the pairs, of precision (6,)."""
        m = len(errors)
        bounds = np.searchsorted(self.tracks.pair, np.arange(m + 1))
        information, gradient = np.zeros((7, 7)), np.zeros(7)
        inner, cross, slope = np.zeros((m, 6, 6)), np.zeros((m, 6, 7)), np.zeros((m, 6))
        for k in range(m):
            part = slice(bounds[k], bounds[k + 1])
            H, g = _normal(r[part], J[part], weight[part])
            inverse = np.linalg.inv(H[7:, 7:] + np.diag(precision))
            inner[k], cross[k], slope[k] = inverse, H[7:, :7], g[7:] + precision * errors[k]
            information += H[:7, :7] - H[:7, 7:] @ inverse @ H[7:, :7]
            gradient += g[:7] - H[:7, 7:] @ inverse @ slope[k]

        def errors_at(step: Matrix) -> tuple[Matrix, Matrix]:
            return -np.einsum("mij,mj->mi", inner, slope + cross @ step), np.diagonal(inner, axis1=1, axis2=2)

        return information, gradient, errors_at

    def _clock(self, R: Matrix) -> float:
        """The offset of the clocks (s) at which the tracks fit best at a rotation; 0 unless another one is clearly better."""
        rng = np.random.default_rng(self._seed)
        part = self.tracks.subset(FINE_TRACKS, rng)
        r = _residuals(R, np.zeros(3), self.motions(), part)
        scale = _scale(r, self._floor)
        costs = np.array([_cost(_residuals(R, np.zeros(3), self.motions(s), part), scale) for s in CLOCKS_S])
        costs = costs * len(part) + 0.5 * (CLOCKS_S / CLOCK_S) ** 2
        return float(CLOCKS_S[int(np.argmin(costs))])

    def _turned(self, R: Matrix, motions: Matrix, tracks: Tracks) -> Matrix:
        """The optimum next to R (3, 3) of a camera at the LiDAR, with equal clocks."""
        for _ in range(ROUNDS):
            r = _residuals(R, np.zeros(3), motions, tracks)
            J = np.stack([(_residuals(turn @ R, np.zeros(3), motions, tracks) - r) / STEP for turn in _TURNS], axis=2)
            scale = _scale(r, self._floor)
            information, gradient = _normal(r, J, 1 / (scale**2 + (r * r).sum(axis=1)))
            step = -np.linalg.solve(information + 1e-3 * np.diag(np.diag(information)) + 1e-9 * np.eye(3), gradient)
            step *= min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-9))
            R = se3.rotation_from_vector(step) @ R
            if np.abs(step).max() < 1e-4:
                break
        return R

    def _linear(self, R: Matrix, c: Matrix, clock: float, errors: Matrix) -> tuple[Matrix, Matrix]:
        """Residuals (n, 2) rad and their derivatives (n, 2, 13) by rotation, centre, clock, and error of the pair's motion."""
        tracks, known = self.tracks, self.motions(clock)
        motions = se3.exp_many(errors) @ known
        r = _residuals(R, c, motions, tracks)
        moved = [_residuals(turn @ R, c, motions, tracks) for turn in _TURNS]
        moved += [_residuals(R, c + STEP * axis, motions, tracks) for axis in np.eye(3)]
        later = se3.exp_many(errors) @ self.motions(clock + CLOCK_STEP_S)
        moved.append(r + (_residuals(R, c, later, tracks) - r) * (STEP / CLOCK_STEP_S))
        for axis in np.eye(6):
            moved.append(_residuals(R, c, se3.exp_many(errors + STEP * axis) @ known, tracks))
        return r, np.stack([(m - r) / STEP for m in moved], axis=2)

    def _flow(self, tracks: Tracks) -> Matrix:
        return np.asarray(np.arccos(np.clip((tracks.first * tracks.second).sum(axis=1), -1, 1)))


_TURNS = np.array([se3.rotation_from_vector(axis) for axis in STEP * np.eye(3)])


def _residuals(R: Matrix, centre: Matrix, motions: Matrix, tracks: Tracks) -> Matrix:
    """Offsets (n, 2) rad of the second directions from the arcs on which they should lie, in the plane across them."""
    turn = R @ motions[:, :3, :3] @ R.T
    shift = (motions[:, :3, 3] + motions[:, :3, :3] @ centre - centre) @ R.T
    a = (turn[tracks.pair] @ tracks.first[:, :, None])[:, :, 0]
    t, x = shift[tracks.pair], tracks.second
    # The point of the plane of a and t that is nearest to x is alpha a + beta t, and beta / alpha the inverse distance.
    at, tt, ax, tx = _dot(a, t), _dot(t, t), _dot(a, x), _dot(t, x)
    alpha, beta = ax * tt - at * tx, tx - at * ax
    with np.errstate(divide="ignore", invalid="ignore"):
        near = np.where(alpha > 0, beta / alpha, np.where(beta > 0, np.inf, 0.0))
    near = np.minimum(np.maximum(near, 0.0), 1 / NEAREST_M)
    q = a + near[:, None] * t
    # The tangent up to 84 deg: unlike the sine it grows with the angle.
    depth = np.maximum(ax + near * tx, 0.1 * np.sqrt(_dot(q, q)))
    e, f = tracks.across
    return np.stack([_dot(q, e) / depth, _dot(q, f) / depth], axis=1)


def _dot(a: Matrix, b: Matrix) -> Matrix:
    return np.asarray(np.einsum("ni,ni->n", a, b))


def _cost(r: Matrix, scale: float) -> float:
    """Mean of Cauchy's cost of residuals (n, 2)."""
    return float(0.5 * np.log1p((r * r).sum(axis=1) / scale**2).mean())


def _scale(r: Matrix, floor: float) -> float:
    """Standard deviation per axis of the agreeing residuals (n, 2), rad: by the median, which is 1.18 of it in a plane."""
    return max(float(np.median(np.linalg.norm(r, axis=1))) / 1.18, floor)


def _normal(r: Matrix, J: Matrix, weight: Matrix) -> tuple[Matrix, Matrix]:
    """Information and gradient of weighted squares: r (n, 2), J (n, 2, k), weight (n,)."""
    rows, values = J.reshape(-1, J.shape[2]), r.ravel()
    w = np.repeat(weight, 2)
    return np.asarray((rows * w[:, None]).T @ rows), np.asarray(rows.T @ (w * values))


def _all_rotations(n: int) -> Matrix:
    """Rotations (n, 3, 3) spread evenly over all (super-Fibonacci spirals, Alexa 2022)."""
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041413
    s = np.arange(n) + 0.5
    r, q = np.sqrt(s / n), np.sqrt(1 - s / n)
    alpha, beta = 2 * np.pi * s / phi, 2 * np.pi * s / psi
    quaternions = np.c_[r * np.sin(alpha), r * np.cos(alpha), q * np.sin(beta), q * np.cos(beta)]
    return np.array([se3.rotation_from_quaternion(own) for own in quaternions])


def distinct(rotations: Matrix, costs: Matrix, least_deg: float) -> list[int]:
    """Positions of at most STARTS of the rotations (k, 3, 3), cheapest first, none nearer than least_deg to a cheaper one."""
    kept: list[int] = []
    for k in np.argsort(costs, kind="stable"):
        if not kept or rotation_distance_deg(rotations[kept], rotations[k]).min() >= least_deg:
            kept.append(int(k))
        if len(kept) == STARTS:
            break
    return kept

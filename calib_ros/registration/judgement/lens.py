"""Does the camera fit the scenes? All that may be wrong of its lens, estimated at once, at the optimum of an extrinsic.

Focal length, aspect, principal point and radial distortion are free together with the extrinsic: damped Gauss-Newton steps in
6 + n unknowns on the edge points of the optimum. A change of the lens moves the rays of the points instead of the pictures, to
first order. How the score bends down around the optimum tells how well the scenes show each, and how each moves the extrinsic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from statistics import NormalDist

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import CameraConfig
from calib_ros.intrinsics import ASPECT, CENTRE, COEFFICIENTS, FOCAL, RADIAL, IntrinsicEstimate, RefinedCamera, changed
from calib_ros.lens import PERSPECTIVE
from calib_ros.registration.covariance import NO_NOISE, REGIONS, STEP, disagreement, inflation, inverse_above, noise_of, scenes_of
from calib_ros.registration.judgement.refusal import GROSSLY, OPEN_PROBABILITY, SIGNIFICANCE, Refusal, left_open, wrong_intrinsics
from calib_ros.registration.objective import SYSTEMATIC_ERROR
from calib_ros.registration.score.chance import EvenPoints
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.score.sampler import MIN_DEPTH, slope_step
from calib_ros.registration.search.constraints import Limits, PoseConstraints, unlimited
from calib_ros.registration.search.optimizers import NEAR_LEVELS, POINTS, REACH, JointView, ascend_jointly, linearised

LEVELS = (2, 3, 4)  # blurred as far as a lens that is 5 % off moves the border of a picture
NODES = (65, 49)  # across and down, at which the effect on rays is computed; between, it is smooth
DIFFERENCE = 1e-4  # of rays and unknowns, for derivatives in float64
AT_ONCE = 30000  # points that OpenCV samples at once
# Standard deviations in advance of aspect and radial distortion, the latter as a displacement of the corner, a share of its
# radius: pixels are square to 0.2 %, and calibrations of one lens differ by 1 to 3 px. And of values that are plainly wrong.
ASPECT_USUAL, RADIAL_USUAL, GROSS = 0.002, 0.004, 0.03
SQUARE = 3 * ASPECT_USUAL  # of pixels that are stated to be so two things must be wrong: the pixels, and what is said of them
ACCUSED = 0.01  # share of right ones that show as much as what is accused
ACCUSING = NormalDist().inv_cdf(1 - ACCUSED / 2)  # standard deviations of that
DRAWS = 512  # from an explanation: tell a probability to 1 %
OBSERVABLE = np.sqrt(0.5)  # of the standard deviation in advance: the scenes then tell as much


@dataclass(frozen=True, eq=False)
class LensUnknown:
    """A change of a camera. name: of `calib_ros.intrinsics`. unit: by which values are multiplied for files. usual: standard
    deviation in advance. rare: share of cameras of which it is plainly wrong. field: (h, w, 2) shift of the ray at every node
    of the working image, per unit of the value. bend: (k, 3) how far some of the rays turn, rad, but for a common turn.
    stated: value of the camera itself, of a distortion."""

    name: str
    unit: float
    usual: float
    field: NDArray[np.float32]
    bend: Matrix
    rare: float = GROSSLY
    stated: float = 0.0


def lens_unknowns(config: CameraConfig, source: Camera, working: Camera) -> tuple[LensUnknown, ...]:
    """What may be wrong of a camera whose pictures are rectified to the pinhole `working`; nothing of one that is exact, or of
    unrolled pictures, where a shift is a rotation, and lenses of another focal length are unrolled otherwise."""
    if working.is_sphere or not config.focal_sigma:
        return ()
    u, v = np.meshgrid(np.linspace(0, working.width - 1, NODES[0]), np.linspace(0, working.height - 1, NODES[1]))
    K = working.K
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1).reshape(-1, 2)
    shift, width, stated = _shifts(source, rays), float(source.width), 0.0
    out = [(FOCAL, 1.0, config.focal_sigma, shift(FOCAL, DIFFERENCE)), (ASPECT, 1.0, ASPECT_USUAL, shift(ASPECT, DIFFERENCE))]
    out += [(name, width, config.centre_sigma, shift(name, 1.0) * width) for name in CENTRE]
    # Of the other models, and of a ratio of two polynomials, the first coefficient is no share of the radius.
    bends = source.model in PERSPECTIVE or not source.is_pinhole
    if source.model in COEFFICIENTS and bends and not np.any(source.D[5:]):
        radial = shift(RADIAL, DIFFERENCE)
        radius = np.linalg.norm(rays, axis=1) * radial.any(axis=1)  # of what the lens sees
        farthest = radius.max() if source.model in PERSPECTIVE else np.arctan(radius.max())
        share = float(farthest) ** 2  # by which a k1 of 1 moves the corner, but for what is stated
        out.append((RADIAL, 1 / share, RADIAL_USUAL, radial / share))
        stated = share * float(source.D[0]) if len(source.D) else 0.0
    shape, square = (NODES[1], NODES[0], 2), abs(source.K[1, 1] / source.K[0, 0] - 1) < SQUARE
    return tuple(
        LensUnknown(
            *(name, unit, usual, moved.reshape(shape).astype(np.float32), _bend(rays, moved)),
            rare=GROSSLY**2 if name == ASPECT and square else GROSSLY,
            stated=stated * (name == RADIAL),
        )
        for name, unit, usual, moved in out
    )


def _shifts(camera: Camera, rays: Matrix) -> Callable[[str, float], Matrix]:
    """Shift (n, 2) of rays (n, 2) per unit of a change of the lens, by steps of it; 0 where the lens does not see."""

    def pixels(camera: Camera, rays: Matrix) -> Matrix:
        return camera.project(np.c_[rays, np.ones(len(rays))])[0]

    off = DIFFERENCE * np.eye(2)
    slope = np.stack([(pixels(camera, rays + d) - pixels(camera, rays - d)) / (2 * DIFFERENCE) for d in off], axis=-1)

    def shift(name: str, step: float) -> Matrix:
        ahead, behind = (pixels(changed(camera, name, sign * step), rays) for sign in (1, -1))
        pixel = (ahead - behind) / (2 * step)
        seen = np.isfinite(pixel).all(axis=1) & np.isfinite(slope).all(axis=(1, 2))
        out = np.zeros_like(pixel)
        out[seen] = np.linalg.solve(slope[seen], pixel[seen][..., None])[..., 0]
        return out

    return shift


def _bend(rays: Matrix, shift: Matrix) -> Matrix:
    """How far every 16th of the nodes across and down is turned, (k, 3) rad, but for the turn that all have in common."""
    some = np.arange(NODES[0] * NODES[1]).reshape(NODES[1], NODES[0])[::16, ::16].ravel()
    r, d = np.c_[rays[some], np.ones(len(some))], np.c_[shift[some], np.zeros(len(some))]
    length = np.linalg.norm(r, axis=1, keepdims=True)
    u = r / length
    turned = (d - u * np.sum(u * d, axis=1, keepdims=True)) / length
    common = np.concatenate([np.cross(axis, u)[..., None] for axis in np.eye(3)], axis=2).reshape(-1, 3)
    return np.asarray(turned - (common @ np.linalg.lstsq(common, turned.ravel(), rcond=None)[0]).reshape(-1, 3))


@dataclass(frozen=True, eq=False)
class LensHypothesis:
    """One way in which a lens may be wrong. wrong: (n,) which unknowns are plainly so, the others as usual. probability: of it.
    mean, covariance: (n,) and (n, n) of the change if it holds."""

    wrong: NDArray[np.bool_]
    probability: float
    mean: Matrix
    covariance: Matrix


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """What the scenes tell of a lens.

    change: (n,) where they match best, with T (4, 4), the extrinsic there; information: (n, n) of it, noise counted, the
    extrinsic free. moves: (6, n) twist of the extrinsic, rad and m, per unit of each; 0 along fixed axes. freedom: degrees of
    freedom of the noise. centre: (n,) change that is expected: back to the stated camera, where this one corrects it. gain:
    log-likelihood over the lens as it is. instead: (n,) with T (4, 4) and the log-likelihood that is lost there, where a
    principal point takes the place of a rotation; None where none was asked about.
    """

    unknowns: tuple[LensUnknown, ...]
    change: Matrix
    T: Transform
    information: Matrix
    moves: Matrix
    freedom: float
    centre: Matrix
    gain: float
    instead: tuple[Matrix, Transform, float] | None = None

    @cached_property
    def sigma(self) -> Matrix:
        """Standard deviations (n,) by the scenes alone."""
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(self.information))))

    @cached_property
    def explanations(self) -> list[LensHypothesis]:
        """All ways in which it may be wrong, the most probable first: each unknown is plainly wrong as rarely as it says."""
        found, n, off = [], len(self.unknowns), self.change - self.centre
        usual = np.array([own.usual for own in self.unknowns])
        rarity = np.array([np.log(own.rare / (1 - own.rare)) for own in self.unknowns])
        for wrong in product((False, True), repeat=n):
            mask = np.array(wrong)
            prior = np.where(mask, np.hypot(GROSS, usual), usual)
            covariance = np.asarray(np.linalg.inv(self.information + np.diag(prior**-2.0)), float)
            mean = covariance @ (self.information @ self.change + self.centre / prior**2)
            # What the scenes show differs from what is expected by their noise and as far as this explanation has it.
            spread = np.linalg.inv(self.information) + np.diag(prior**2)
            distance = float(off @ np.linalg.solve(spread, off))
            log_density = -0.5 * (self.freedom + n) * np.log1p(distance / self.freedom) - 0.5 * np.linalg.slogdet(spread)[1]
            found.append((log_density + float(rarity[mask].sum()), mask, mean, covariance))
        logs = np.array([own[0] for own in found])
        odds: Matrix = np.exp(logs - logs.max())
        out = [LensHypothesis(mask, float(p), mean, C) for p, (_, mask, mean, C) in zip(odds / odds.sum(), found, strict=True)]
        return sorted(out, key=lambda own: -own.probability)

    @cached_property
    def posterior(self) -> tuple[Matrix, Matrix]:
        """Mean (n,) and covariance (n, n) of the change, over all explanations."""
        mean = sum((own.probability * own.mean for own in self.explanations), np.zeros(len(self.unknowns)))
        spread = (own.probability * (own.covariance + np.outer(own.mean - mean, own.mean - mean)) for own in self.explanations)
        return mean, np.asarray(sum(spread))

    def effect(self, constraints: PoseConstraints, covariance: Covariance, kept: Sequence[int] = ()) -> tuple[Matrix, Covariance]:
        """Twist (6, n) of the extrinsic from the optimum by the lens as it is, whose own covariance is `covariance`, per unit of
        each change, and the second moment (n, n) of these. kept: axes that are those of the start, whatever the lens."""
        moves, (mean, spread) = self.moves.copy(), self.posterior
        moves[list(kept)] = 0.0
        if constraints.prior:
            moves = moves - covariance @ (constraints.information()[:, None] * moves)
        moment = spread + np.outer(mean, mean)
        farthest = constraints.limits.half[:, None] / np.sqrt(np.diag(moment))
        return np.clip(moves, -farthest, farthest), np.asarray(moment)

    @property
    def left_open(self) -> Covariance:
        """(6, 6), what the scenes leave open of the extrinsic by what they leave open of the lens."""
        return np.asarray(self.moves @ self.posterior[1] @ self.moves.T)

    def refined_camera(self, camera: Camera, T: Transform, extrinsic: Covariance) -> RefinedCamera:
        """The camera with the change that is expected, if the scenes show one (F test): a right one would else get their noise.
        T, extrinsic: the optimum (4, 4) by `camera`, its covariance (6, 6)."""
        (mean, spread), n = self.posterior, len(self.unknowns)
        if not self._exceeds(float(self.change @ self.information @ self.change), SIGNIFICANCE):
            mean, spread = np.zeros(n), spread + np.outer(mean, mean)
        units = np.array([own.unit for own in self.unknowns])
        T, changes = se3.exp(self.moves @ mean) @ T, {}
        for own, value, sigma in zip(self.unknowns, mean * units, np.sqrt(np.diag(spread)) * units, strict=True):
            camera = changed(camera, own.name, float(value))
            changes[own.name] = IntrinsicEstimate(float(value), float(sigma), bool(sigma < OBSERVABLE * own.unit * own.usual))
        lens, along = spread * np.outer(units, units), self.moves / units
        both = np.block([[extrinsic + along @ lens @ along.T, along @ lens], [lens @ along.T, lens]])
        return RefinedCamera(camera, T, changes, both)

    def in_files(self) -> dict[str, IntrinsicEstimate]:
        """What the scenes alone tell of each unknown."""
        return {
            own.name: IntrinsicEstimate(float(own.unit * value), float(own.unit * sigma), bool(sigma < own.usual))
            for own, value, sigma in zip(self.unknowns, self.change, self.sigma, strict=True)
        }

    def fault(self, camera: Camera, deg: float, m: float, doubt: float = 0.5) -> Refusal | None:
        """What is wrong such that it matters, with a probability of 1 - doubt, or too uncertain, of OPEN_PROBABILITY if it is
        plainly so: points are seen more than deg elsewhere, or the extrinsic is more than deg or m elsewhere; None where all may
        be right. camera: as it is stated.

        A turn across the view does not count: it looks like another principal point, and who projects with the camera as it is
        stated never sees it.
        """
        moves = self.moves[2:] / np.array([[np.deg2rad(deg)], [m], [m], [m]])
        bends = np.stack([own.bend for own in self.unknowns], axis=-1) / np.deg2rad(deg)

        def off_by(own: LensHypothesis) -> float:
            """Probability that it holds, something is plainly wrong, and the extrinsic is off."""
            draws = np.linalg.cholesky(own.covariance) @ _draws(len(self.unknowns))
            ends = moves @ (own.mean[:, None] + draws)
            return own.probability * float(((np.abs(ends[0]) > 1) | (np.linalg.norm(ends[1:], axis=0) > 1)).mean())

        best, off = self.explanations[0], [off_by(own) if own.wrong.any() else 0.0 for own in self.explanations]
        farthest = bends[int(np.linalg.norm(bends @ best.mean, axis=1).argmax())]
        parts = farthest, moves[:1], moves[1:]
        beyond = [_beyond(part @ best.mean, part @ best.covariance @ part.T) for part in parts]
        ratio = 0.5 * (self.freedom + 1) * float(np.log1p(max(beyond) / self.freedom))  # Student's distribution
        part = parts[int(np.argmax(beyond))]
        k = int(np.linalg.norm(part * best.mean, axis=0).argmax())
        # What is not shown, and only expected to be as it may be usually, accuses nothing.
        shown = abs(self.change[k]) > ACCUSING * self.sigma[k] and ratio > np.log(1 / doubt - 1)
        # Nor does what the score hardly gains by: its top may be narrower than the way to it is high.
        if shown and self._exceeds(2 * self.gain, ACCUSED):
            return self.wrong(k, best.mean, camera)
        if sum(off) <= OPEN_PROBABILITY:
            return None
        most = self.explanations[int(np.argmax(off))]
        k = int(np.linalg.norm(moves * most.mean, axis=0).argmax())
        if sum(off) >= 1 - doubt and self._exceeds(2 * self.gain, ACCUSED):
            return self.wrong(k, most.mean, camera)
        own = self.unknowns[k]
        return left_open(own.name, own.unit * self.change[k], own.unit * self.sigma[k], min(sum(off), 1 - 1e-9), deg, m)

    def wrong(self, k: int, change: Matrix, camera: Camera) -> Refusal:
        """It is off by this change (n,), of which the unknown k matters most."""
        own, values = self.unknowns[k], {own.name: float(value) for own, value in zip(self.unknowns, change, strict=True)}
        removed = bool(abs(own.stated + change[k]) < 0.5 * abs(own.stated))
        # By how many standard deviations of the scenes and in advance together.
        deviations = float(abs(self.change[k] - self.centre[k]) / np.hypot(self.sigma[k], own.usual))
        return wrong_intrinsics(own.name, values, camera, removed, deviations)

    @property
    def expected(self) -> tuple[Matrix, Transform]:
        """The change (n,) that is expected by now, and the extrinsic (4, 4) there."""
        mean = self.posterior[0]
        return mean, se3.exp(self.moves @ (mean - self.change)) @ self.T

    def seen(self, score: PointScore) -> tuple[PointScore, Transform]:
        """A score as it is by the lens that is expected by now, and the extrinsic (4, 4) there."""
        mean, T = self.expected
        P = _seeing(score, self.unknowns)(T, mean)[0].points
        back = se3.inverse(T).astype(np.float32)
        return score.with_points(back[:3, :3] @ P + back[:3, 3:]), T

    def _exceeds(self, square: float, share: float) -> bool:
        """F test of all unknowns: whether only so small a share of right lenses shows more."""
        n = len(self.unknowns)
        return square > n and bool(square > n * scipy.special.fdtri(n, self.freedom, 1 - share))


@cache
def _draws(n: int) -> Matrix:
    """(n, k) of a standard normal distribution, evenly spread."""
    return np.asarray(np.vectorize(NormalDist().inv_cdf)(0.5 + 0.5 * EvenPoints(n, 0).next(DRAWS)).T)


def _beyond(mean: Matrix, covariance: Matrix) -> float:
    """Squared distance of an offset (k,) of this covariance from the nearest one within 1, in standard deviations: 0 within."""
    if np.linalg.norm(mean) <= 1:
        return 0.0
    information, near = np.linalg.inv(covariance + 1e-9 * np.eye(len(mean))), mean
    low, high = 0.0, 1e12
    for _ in range(100):  # the multiplier at which the nearest one is on the ball
        middle = np.sqrt(max(low, 1e-12) * high)
        near = np.linalg.solve(information + middle * np.eye(len(mean)), information @ mean)
        low, high = (middle, high) if np.linalg.norm(near) > 1 else (low, middle)
    return float((mean - near) @ information @ (mean - near))


def estimate_lens(
    score: PointScore,
    T: Transform,
    limits: Limits,
    unknowns: Sequence[LensUnknown],
    inflated: float = 1.0,
    centre: Matrix | None = None,
    turned: Transform | None = None,
) -> LensEstimate | None:
    """The joint optimum near T (4, 4), that of a score by the lens as it is; None where nothing is unknown.

    limits: axes that are fixed are free here, for what is fixed wrongly is no lens, but no lens moves them. inflated: factor of
    the noise, by the disagreement of halves at T. centre: (n,), see `LensEstimate`. turned: (4, 4) whose rotation
    another principal point may explain, however far beside it lies.
    """
    if not unknowns or not limits.open_axes.any():
        return None
    n, part, free = len(unknowns), score.subset(POINTS, np.random.default_rng(0)), unlimited(T)
    see, as_it_is = _seeing(part, unknowns), np.zeros(n)
    T_given, _, lower = ascend_jointly(see, T, as_it_is, NEAR_LEVELS, free, free=np.zeros(n, bool))
    # Few frames have several tops; and pictures that are rectified already are far from what is stated.
    radial, stated = np.array([own.name == RADIAL for own in unknowns], float), unknowns[-1].stated
    begun = (GROSS, -GROSS, -stated) if abs(stated) > GROSS else (GROSS, -GROSS)
    starts, aside = [(T, as_it_is), *((T, value * radial) for value in begun if radial.any())], []
    if turned is not None:
        across = se3.rotation_vector(T[:3, :3] @ turned[:3, :3].T)[:2] * score.camera.K[0, 0] / score.camera.width
        looks = {CENTRE[0]: across[1], CENTRE[1]: -across[0]}
        by = np.array([looks.get(own.name, 0.0) for own in unknowns])
        aside = [ascend_jointly(see, se3.from_parts(turned[:3, :3], T[:3, 3]), by, LEVELS, free)]
    for level in LEVELS:
        starts += [(T_given, as_it_is)] if level == NEAR_LEVELS[0] else []
        ends = sorted((ascend_jointly(see, *start, (level,), free) for start in starts), key=lambda end: -end[2])
        starts, kept, finer = [], list[Matrix](), part.atlas.levels[min(level + 1, part.n_levels - 1)]
        for *end, _ in ends:
            # By the root of their mean square; ends that show points nearer than a slope reaches have the same top.
            (x, y, z), K = see(*end)[0].points, finer.K
            pixels = np.stack([K[0, 0] * x, K[1, 1] * y]) / np.maximum(z, MIN_DEPTH) * part.weights**0.5
            if all(np.linalg.norm(pixels - other) > slope_step(finer) for other in kept):
                starts.append((end[0], end[1]))
                kept.append(pixels)
    T, change, higher = max([ends[0], *aside], key=lambda end: end[2])
    there, own = see(T, change)[0], unlimited(np.eye(4))
    # Halves may disagree because of the wrong lens.
    noise = noise_of(there, np.eye(4), own) * min(inflated, inflation(disagreement(there, np.eye(4), own)))
    information, moves = _bending(see, T, change, unknowns, part, noise, limits.open_axes)
    if limits.open_axes.all():  # both optima are those of all axes
        # Such that the move to the optimum is included: farther away than a step, the score bends otherwise (Broyden 1965).
        missing, weighed = se3.log(T @ se3.inverse(T_given)) - moves @ change, information @ change
        moves = moves + np.outer(missing, weighed) / (float(change @ weighed) + 1)
    freedom = max(REGIONS * scenes_of(score) - 6 - n, 1.0)
    centre, gain = as_it_is if centre is None else centre, max(higher - lower, 0.0) / noise
    instead = [(by, at, (higher - value) / noise) for at, by, value in aside]
    return LensEstimate(tuple(unknowns), change, T, information, moves, freedom, centre, gain, *instead)


def _seeing(score: PointScore, unknowns: Sequence[LensUnknown]) -> Callable[[Transform, Matrix], JointView]:
    """What sees the points of a score from an extrinsic (4, 4) with a change (n,) of the lens, in the camera's axes."""
    fields, n = np.concatenate([own.field for own in unknowns], axis=2), len(unknowns)
    points, K, camera = score.points, score.camera.K, score.camera
    per_px = (np.array(NODES) - 1) / (np.array([camera.width, camera.height]) - 1)
    scale, first_node = ((per_px * part)[:, None].astype(np.float32) for part in (np.diag(K)[:2], K[:2, 2]))

    def see(T: Transform, change: Matrix) -> JointView:
        motion = T.astype(np.float32)
        P = motion[:3, :3] @ points + motion[:3, 3:]
        z = np.maximum(P[2], np.float32(1e-3))
        node = (P[:2] / z * scale + first_node).clip(-1, 2 * NODES[0])
        shifts = np.empty((2 * n, P.shape[1]), np.float32)
        for first in range(0, P.shape[1], AT_ONCE):
            own = slice(first, first + AT_ONCE)
            at = np.ascontiguousarray(node[:, None, own])
            shifts[:, own] = cv2.remap(fields, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0].T
        shifts *= z
        across, down = shifts[::2], shifts[1::2]
        P[:2] += np.tensordot(change.astype(np.float32), shifts.reshape(n, 2, -1), 1)
        # Slopes by a shift of the point across and down, of which each unknown makes so many m.
        return score.with_points(P), np.eye(4), lambda J: J[3] * across + J[4] * down

    return see


def _bending(
    see: Callable[[Transform, Matrix], JointView],
    T: Transform,
    change: Matrix,
    unknowns: Sequence[LensUnknown],
    score: PointScore,
    noise: float,
    open_axes: NDArray[np.bool_],
) -> tuple[Matrix, Matrix]:
    """Information (n, n) of a change and the twist (6, n) of the extrinsic per unit of it: by central differences of the
    gradient, over steps as far as those of the extrinsic's own covariance move a picture."""
    n, K, level = len(unknowns), score.camera.K, score.n_levels - 1
    moved = [np.sqrt(np.mean((own.field * np.diag(K)[:2]) ** 2)) for own in unknowns]
    steps = np.r_[STEP, STEP[0] * K[0, 0] / np.maximum(moved, 1e-9)]
    H = np.zeros((6 + n, 6 + n))
    for k in range(6 + n):
        off = np.zeros(6 + n)
        off[k] = steps[k]
        ahead, behind = (linearised(see(se3.exp(sign * off[:6]) @ T, change + sign * off[6:]), n, level)[0] for sign in (1, -1))
        H[k] = (behind - ahead) / (2 * steps[k])
    H = 0.5 * (H + H.T)
    units = np.outer(steps, steps)
    scale = linearised(see(T, change), n, level)[1]
    # What no point shows of the extrinsic lies within reach.
    nothing = np.diag(noise * np.r_[REACH, np.full(n, np.inf)] ** -2.0)
    H, scale = H + nothing, scale + nothing
    values, vectors = np.linalg.eigh(scale * units)
    root = vectors / np.sqrt(np.maximum(values, NO_NOISE * values.max()))
    C = inverse_above(H * units, root)
    lens, own = units[6:, 6:] * C[6:, 6:], np.flatnonzero(open_axes)
    bent, directions = np.linalg.inv(C), np.zeros((6, n))
    # The optimum of the open axes, the others held.
    directions[own] = -np.linalg.solve(bent[np.ix_(own, own)], bent[own, 6:]) * (steps[own, None] / steps[6:])
    # What shifts the border of the image as far as the systematic error of a rotation does.
    px = SYSTEMATIC_ERROR[0] * K[0, 0]
    systematic = np.array([px / score.camera.width * (1.0 if own.name in CENTRE else 2.0) for own in unknowns])
    return np.asarray(np.linalg.inv(noise * lens + np.diag(systematic**2))), directions

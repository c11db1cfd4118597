"""The intrinsics estimated together with the extrinsic: focal length, principal point, and the radial distortion where it shows.

All are free at once: damped Gauss-Newton steps in 6 + n unknowns, from several values of each, on the edge maps as they are. A
change of the lens moves the rays of the points instead of the pictures, to first order: so the pictures are rectified anew by the
corrected camera, and the change that is left is estimated again, until there is none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Covariance, Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.config import CameraConfig
from calib_ros.intrinsics import CENTRE, COEFFICIENTS, FOCAL, RADIAL, IntrinsicEstimate, RefinedCamera, change_between, changed
from calib_ros.registration.acceptance.split_half import disagreement, inflation
from calib_ros.registration.nuisance.lens import CENTRE as CENTRE_VALUES
from calib_ros.registration.nuisance.lens import FOCAL as FOCAL_VALUES
from calib_ros.registration.nuisance.lens import Intrinsic
from calib_ros.registration.nuisance.parameters import LEVELS, NEAR_LEVELS, POINTS, noise_of
from calib_ros.registration.nuisance.time_offset import FINE_POINTS
from calib_ros.registration.objective import SYSTEMATIC_ERROR
from calib_ros.registration.score.point_score import PointScore
from calib_ros.registration.search.constraints import Limits, Prior
from calib_ros.registration.search.optimizers import JointView, ascend_jointly

# Standard deviations of the radial distortion, as a displacement of the corner, a share of its radius: 1 to 3 px are usual.
RADIAL_USUAL, RADIAL_GROSS = 0.004, 0.03
DOUBT = 0.5  # probability in advance that a value is plainly wrong: who asks for another one has a reason
RADIAL_VALUES = (-0.08, -0.04, 0.04, 0.08)  # shares of the corner's radius that are tried
STEP = 0.005  # of every parameter for the profile: 3 px at the border of an image of 1280
NODES = (65, 49)  # across and down, at which the effect on rays is computed; between, it is smooth
DIFFERENCE = 1e-4  # of rays and parameters, for derivatives in float64
FOLLOWED = 3  # of the best starts, how many are followed to the finest level
OBSERVABLE = np.sqrt(0.5)  # of the standard deviation in advance: the scenes then tell as much


@dataclass(frozen=True, eq=False)
class LensParameter:
    """A change of a camera. unit: by which values are multiplied for files. usual, gross: standard deviations in advance, of
    usual values and of those that are plainly wrong. field: (h, w, 2) shift of the ray at every node of the working image, per
    unit of the value. alternatives: values to begin from."""

    name: str
    unit: float
    usual: float
    gross: float
    field: NDArray[np.float32]
    alternatives: Sequence[float]


def lens_parameters(config: CameraConfig, source: Camera, working: Camera) -> tuple[LensParameter, ...]:
    """What can be told of a camera by pictures that are rectified to the pinhole `working`, but for what is exact."""
    u, v = np.meshgrid(np.linspace(0, working.width - 1, NODES[0]), np.linspace(0, working.height - 1, NODES[1]))
    K = working.K
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], axis=-1).reshape(-1, 2)
    shift = _shifts(source, rays)
    focal = _grid(shift(FOCAL, DIFFERENCE))
    out = [LensParameter(FOCAL, 1.0, config.focal_sigma, Intrinsic.gross, focal, FOCAL_VALUES)]
    for name in CENTRE:
        field, unit = _grid(shift(name, 1.0) * source.width), float(source.width)
        out.append(LensParameter(name, unit, config.centre_sigma, Intrinsic.gross, field, CENTRE_VALUES))
    if source.model in COEFFICIENTS:  # of the other models the first coefficient is no share of the radius
        radial = shift(RADIAL, DIFFERENCE)
        radius = np.linalg.norm(rays, axis=1) * radial.any(axis=1)  # of what the lens sees
        corner = int(radius.argmax())
        share = float(np.linalg.norm(radial[corner])) / radius[corner]  # by which a k1 of 1 moves the corner
        out.append(LensParameter(RADIAL, 1 / share, RADIAL_USUAL, RADIAL_GROSS, _grid(radial / share), RADIAL_VALUES))
    return tuple(parameter for parameter in out if parameter.usual > 0)


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


def _grid(shift: Matrix) -> NDArray[np.float32]:
    """(n, 2) -> (h, w, 2) of the nodes."""
    return np.ascontiguousarray(shift.reshape(NODES[1], NODES[0], 2), np.float32)


@dataclass(frozen=True, eq=False)
class _Joint:
    """The score in 6 + n unknowns. limits, prior: of the extrinsic. What is known in advance of the intrinsics is weighed by
    `noise`: changes about `centre` (n,) are usual each, or, with probability DOUBT, plainly wrong."""

    score: PointScore
    parameters: Sequence[LensParameter]
    limits: Limits
    prior: Prior | None
    centre: Matrix
    noise: float

    def seen(self, T: Transform, change: Matrix) -> JointView:
        """The points from T (4, 4) with a change (n,) of the lens, in the camera's axes."""
        P = T[:3, :3] @ self.score.points.astype(np.float64) + T[:3, 3:]
        z, K, camera = np.maximum(P[2], 1e-3), self.score.camera.K, self.score.camera
        scale = (NODES[0] - 1) / (camera.width - 1), (NODES[1] - 1) / (camera.height - 1)
        node = [((K[i, i] * P[i] / z + K[i, 2]) * scale[i]).clip(-1, 2 * NODES[i]).astype(np.float32)[None] for i in (0, 1)]
        fields = np.concatenate([own.field for own in self.parameters], axis=2)
        shifts = np.empty((2 * len(self.parameters), P.shape[1]))
        for first in range(0, P.shape[1], 30000):  # what OpenCV takes at once
            own = slice(first, first + 30000)
            at = [np.ascontiguousarray(part[:, own]) for part in node]
            shifts[:, own] = cv2.remap(fields, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0].T
        shifts = shifts.reshape(len(self.parameters), 2, -1) * z
        P[:2] += np.einsum("k,kin->in", change, shifts)
        # Slopes by a shift of the point across and down, of which each parameter makes so many m.
        return self.score.with_points(P.astype(np.float32)), np.eye(4), lambda J: J[3] * shifts[:, 0] + J[4] * shifts[:, 1]

    def ascend(
        self, T: Transform, change: Matrix, levels: Sequence[int], free: NDArray[np.bool_] | None = None
    ) -> tuple[Matrix, Matrix, float]:
        """The optimum near T (4, 4) and a change (n,), where `free` (n,). -> T, change, and the score less the priors."""
        found = ascend_jointly(self.seen, T, change, levels, self.limits, self.prior, free, self.known)
        return found[0], found[1], found[3]

    def known(self, change: Matrix) -> tuple[float, Matrix, Matrix]:
        """Cost of a change (n,) by what is known in advance, to subtract from the score, its slope and its information (n,)."""
        here, most = self._densities(change)[0].sum(axis=0), self._densities(self.centre)[0].sum(axis=0)
        information = self.noise * self.information(change)
        # Less the logarithm of the density, 0 where it is highest.
        return self.noise * float(np.log(most / here).sum()), information * (change - self.centre), information

    def information(self, change: Matrix) -> Matrix:
        """Slope of the cost (n,) per distance from the centre: the information of the normal distribution that is as steep."""
        densities, sigma = self._densities(change)
        return np.asarray((densities / sigma**2).sum(axis=0) / densities.sum(axis=0))

    def _densities(self, change: Matrix) -> tuple[Matrix, Matrix]:
        """Of both kinds of changes (2, n), each times its probability; and their standard deviations (2, n)."""
        sigma = np.array([[own.usual for own in self.parameters], [own.gross for own in self.parameters]])
        share = np.array([[1 - DOUBT], [DOUBT]])
        return share / sigma * np.exp(-0.5 * ((change - self.centre) / sigma) ** 2) + 1e-300, sigma


def joint_optimum(
    score: PointScore,
    T: Transform,
    limits: Limits,
    prior: Prior | None,
    camera: Camera,
    config: CameraConfig,
    inflated: float,
    extrinsic: Covariance,
    search: bool = False,
    given: Camera | None = None,
) -> RefinedCamera | None:
    """The optimum of extrinsic and intrinsics near T (4, 4); None for unrolled pictures, which show no intrinsics, and where all
    is exact.

    score: of pictures of `camera`. limits, prior: of the extrinsic. inflated: factor of the variance, by the disagreement of
    halves at T. extrinsic: its covariance (6, 6) if the intrinsics are right. search: values far off are tried as well. given:
    the camera that was stated, where `camera` corrects it already.
    """
    parameters = () if score.camera.is_sphere else lens_parameters(config, camera, score.camera)
    if not parameters or not limits.open_axes.any():
        return None
    part = score.subset(POINTS if given is None else FINE_POINTS, np.random.default_rng(0))
    limits = Limits(T, np.where(limits.open_axes, np.inf, 0.0))
    centre = np.array([-change_between(given or camera, camera, own.name) / own.unit for own in parameters])
    joint = _Joint(part, parameters, limits, prior, centre, 0.0)
    free, as_it_is = Limits(np.eye(4), np.where(limits.open_axes, np.inf, 0.0)), (T, np.zeros(len(parameters)))
    begin = as_it_is
    if search or given is not None:  # by the scenes alone: at an optimum of wrong intrinsics, nothing tells their noise
        ends = [(*as_it_is, 0.0)]
        if search:
            ends = [joint.ascend(*start, LEVELS[:-1]) for start in _starts(T, part.camera, parameters)]
            ends = sorted(ends, key=lambda end: -end[2])[:FOLLOWED]
        begin = max((joint.ascend(*end[:2], NEAR_LEVELS) for end in ends), key=lambda end: end[2])[:2]
    part = joint.seen(*begin)[0]
    # The halves' disagreement at T may be that of the wrong intrinsics.
    if begin is not as_it_is:
        inflated = min(inflated, inflation(disagreement(part, np.eye(4), free)))
    joint = replace(joint, noise=inflated * noise_of(part, np.eye(4), free))
    starts = [as_it_is] if begin is as_it_is else [begin, as_it_is, *_as_usual(*begin, joint)]
    top, change, best = max((joint.ascend(*start, NEAR_LEVELS) for start in starts), key=lambda end: end[2])
    covariance, directions = _spread(joint, top, change, best)
    known = np.sqrt(1 / joint.information(change))
    observable = np.asarray(np.sqrt(np.diag(covariance)) < OBSERVABLE * known)
    if not observable.all():  # these stay as they are
        kept = np.where(observable, change, 0.0)
        top, change, best = joint.ascend(_turned(top, kept - change, part.camera, parameters), kept, NEAR_LEVELS, observable)
        covariance, directions = _spread(joint, top, change, best)
    units, changes = np.array([own.unit for own in parameters]), {}
    for own, value, sigma, seen in zip(parameters, change, np.sqrt(np.diag(covariance)), observable, strict=True):
        camera = changed(camera, own.name, own.unit * float(value))
        changes[own.name] = IntrinsicEstimate(float(own.unit * value), float(own.unit * sigma), bool(seen))
    lens, along = covariance * np.outer(units, units), directions / units
    return RefinedCamera(
        camera, top, changes, np.block([[extrinsic + along @ lens @ along.T, along @ lens], [lens @ along.T, lens]])
    )


def _spread(joint: _Joint, T: Transform, change: Matrix, top: float) -> tuple[Matrix, Matrix]:
    """Covariance (n, n) of a change at the optimum T (4, 4), and the twist of the extrinsic (6, n) per unit of it: by how the
    score bends down around it, the extrinsic refined anew for each, by differences of STEP, without the prior of the change."""
    n = len(change)

    def costs(T: Transform, change: Matrix) -> tuple[float, float]:
        """Of both priors together, and of that of the extrinsic."""
        prior = joint.prior.value(T) if joint.prior else 0.0
        return joint.known(change)[0] + prior, prior

    def at(off: Matrix, begin: Transform) -> tuple[Matrix, float]:
        end, _, value = joint.ascend(begin, change + off, NEAR_LEVELS, np.zeros(n, bool))
        both, prior = costs(end, change + off)
        return end, value + both - prior

    axes, H, directions = STEP * np.eye(n), np.zeros((n, n)), np.zeros((6, n))
    both, prior = costs(T, change)
    top += both - prior
    for k in range(n):
        (ahead, high), (behind, low) = (at(sign * axes[k], T) for sign in (1, -1))
        directions[:, k] = np.where(joint.limits.open_axes, se3.log(ahead @ se3.inverse(behind)), 0.0) / (2 * STEP)
        H[k, k] = (2 * top - high - low) / STEP**2
    for i, j in combinations(range(n), 2):
        off = axes[i] + axes[j]
        ends = [at(sign * off, se3.exp(sign * directions @ off) @ T)[1] for sign in (1, -1)]
        along = (2 * top - sum(ends)) / STEP**2
        H[i, j] = H[j, i] = 0.5 * (along - H[i, i] - H[j, j])
    known, camera = 1 / np.sqrt(joint.information(change)), joint.score.camera
    values, vectors = np.linalg.eigh(H / joint.noise * np.outer(known, known))
    covariance = (vectors / (np.maximum(values, 0) + 1)) @ vectors.T * np.outer(known, known)  # bent upward, it tells nothing
    # What shifts the border of the image as far as the systematic error of a rotation does.
    px = SYSTEMATIC_ERROR[0] * camera.K[0, 0]
    systematic = np.array([px / camera.width * (1.0 if own.name in CENTRE else 2.0) for own in joint.parameters])
    covariance += np.diag(systematic**2)
    return 0.5 * (covariance + covariance.T), directions


def _starts(T: Transform, camera: Camera, parameters: Sequence[LensParameter]) -> Iterator[tuple[Matrix, Matrix]]:
    """Where to begin: as it is, and other values of each parameter, with the rotation that another principal point looks like."""
    yield T, np.zeros(len(parameters))
    for k, own in enumerate(parameters):
        for value in own.alternatives:
            change = np.zeros(len(parameters))
            change[k] = value
            yield _turned(T, change, camera, parameters), change


def _as_usual(T: Transform, change: Matrix, joint: _Joint) -> Iterator[tuple[Matrix, Matrix]]:
    """The same with some of the values as they were given: with what is known in advance they may score higher."""
    groups = [[k for k, own in enumerate(joint.parameters) if own.name in names] for names in (CENTRE, (RADIAL,))]
    for some in (groups[0], groups[1], groups[0] + groups[1]):
        if some:
            usual = change.copy()
            usual[some] = joint.centre[some]
            yield _turned(T, usual - change, joint.score.camera, joint.parameters), usual


def _turned(T: Transform, change: Matrix, camera: Camera, parameters: Sequence[LensParameter]) -> Matrix:
    """T (4, 4) with the rotation that looks like a change (n,) of the principal point, undone."""
    turn = np.zeros(6)
    for own, value in zip(parameters, change, strict=True):
        if own.name in CENTRE:
            angle = value * camera.width / camera.K[0, 0]
            turn[:2] += (0.0, -angle) if own.name == CENTRE[0] else (angle, 0.0)
    return np.asarray(se3.exp(turn) @ T)

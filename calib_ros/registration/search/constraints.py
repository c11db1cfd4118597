"""Where the extrinsic may lie (limits), where it probably lies (prior), and where it is searched (box).

All are counted in the twist xi = log(T anchor^-1), in the camera's axes: rotations about the camera's own centre, so that
with all three translations fixed the camera stays where it is in the LiDAR frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.config import NO_LIMIT_DEG, NO_LIMIT_M, ConstraintsConfig, SearchConfig
from calib_ros.errors import ConfigError

# deg, m per axis from its start: a refinement goes no further, and one that ends there is refused, since it has left its basin.
REFINEMENT_DEG, REFINEMENT_M = 3.0, 0.5
NEARLY = 0.97  # of a limit, where an optimiser without slopes ends that would go beyond it
SCORE_NOISE = 0.03  # per frame; single frames, error' H error / 6: median 0.04 and 0.02 on two KITTI drives, 0.01 synthetic


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior around T: information (6,) per axis of the twist log(T' T^-1), in units of the score."""

    T: Transform
    information: Matrix

    @cached_property
    def _inverse(self) -> Matrix:
        return se3.inverse(self.T)

    def cost(self, T: Transform) -> tuple[float, Matrix]:
        """Cost to subtract from the score, and its gradient (6,)."""
        xi = se3.log(T @ self._inverse)
        return 0.5 * float(self.information @ (xi * xi)), self.information * xi


@dataclass(frozen=True, eq=False)
class Limits:
    """How far each axis of the twist log(T' T^-1) may go: half (6,) in rad and m; 0 = fixed, inf = free. trust_region: further
    limits, around the extrinsic that an optimisation starts from."""

    T: Transform
    half: Matrix
    trust_region: Limits | None = None

    @cached_property
    def _inverse(self) -> Matrix:
        return se3.inverse(self.T)

    @cached_property
    def _is_free(self) -> bool:
        """Nothing but the trust region limits any axis. Asked for at every step of an optimisation."""
        return bool(np.isinf(self.half).all())

    @property
    def open_axes(self) -> NDArray[np.bool_]:
        """(6,) False where an axis is fixed."""
        return np.asarray(self.half > 0)

    def clip(self, T: Transform) -> Transform:
        """The nearest extrinsic within the limits; T itself if it is within."""
        T = self.trust_region.clip(T) if self.trust_region is not None else T
        if self._is_free:
            return T
        xi = se3.log(T @ self._inverse)
        return T if (np.abs(xi) <= self.half).all() else se3.exp(np.clip(xi, -self.half, self.half)) @ self.T

    def movable(self, T: Transform, gradient: Matrix) -> NDArray[np.bool_]:
        """(6,) axes along which the score can be raised from T: not those that are fixed, or at a limit that the gradient (6,)
        pushes against."""
        free = self.trust_region.movable(T, gradient) if self.trust_region is not None else np.ones(6, bool)
        if self._is_free:
            return free
        xi = se3.log(T @ self._inverse)
        return np.asarray(free & (self.half > 0) & ~((np.abs(xi) >= self.half * (1 - 1e-9)) & (gradient * xi > 0)))


def unlimited(T: Transform) -> Limits:
    """No limits at all."""
    return Limits(T, np.full(6, np.inf))


@dataclass(frozen=True, eq=False)
class PoseConstraints:
    """Limits and, if there is one, the prior of an extrinsic, for a score of so many frames."""

    limits: Limits
    prior: Prior | None = None
    frames: int = 1

    def cost(self, T: Transform) -> float:
        """Cost of the prior at T (4, 4), to subtract from the score."""
        return 0.0 if self.prior is None else self.prior.cost(T)[0]

    def active_limits(self, T: Transform, gradient: Matrix) -> NDArray[np.bool_]:
        """(6,) axes at a limit that the score, of `gradient` (6,) at T, or the prior pushes against."""
        if np.isinf(self.limits.half).all():
            return np.zeros(6, bool)
        xi = se3.log(T @ se3.inverse(self.limits.T))
        uphill = gradient if self.prior is None else gradient - self.prior.cost(T)[1]
        return np.asarray(self.limits.open_axes & (np.abs(xi) >= NEARLY * self.limits.half) & (uphill * xi > 0))

    def within_trust_region(self, T: Transform, max_deg: float, max_m: float) -> PoseConstraints:
        """The same, and nothing farther than this from T (4, 4) per axis."""
        trust_region = Limits(T, np.array([np.deg2rad(max_deg)] * 3 + [max_m] * 3))
        return replace(self, limits=replace(self.limits, trust_region=trust_region))

    def with_frames(self, frames: int) -> PoseConstraints:
        """The same for a score of another number of frames: its noise, which the prior is weighed against, changes."""
        if self.prior is None or frames == self.frames:
            return replace(self, frames=frames)
        return PoseConstraints(self.limits, Prior(self.prior.T, self.prior.information * self.frames / frames), frames)

    def information(self) -> Matrix:
        """Information (6,) of the prior in 1/rad^2 and 1/m^2."""
        return np.zeros(6) if self.prior is None else self.prior.information * self.frames / SCORE_NOISE


def pose_constraints(T: Transform, config: ConstraintsConfig, n_frames: int) -> PoseConstraints:
    """The stage ``constraints`` of the configuration around an extrinsic T (4, 4), for a score of n_frames, whose own covariance
    is SCORE_NOISE / n_frames times its inverse Gauss-Newton matrix: prior and score are weighed as two measurements."""
    half = np.concatenate([np.deg2rad(config.limit_deg), config.limit_m])
    half[:3][np.asarray(config.limit_deg) >= NO_LIMIT_DEG] = np.inf
    half[3:][np.asarray(config.limit_m) >= NO_LIMIT_M] = np.inf
    sigma = np.concatenate([np.deg2rad(config.sigma_deg), config.sigma_m])
    with np.errstate(divide="ignore"):
        information = np.where(sigma > 0, SCORE_NOISE / n_frames / sigma**2, 0.0)
    return PoseConstraints(Limits(T, half), Prior(T, information) if information.any() else None, n_frames)


Axes = float | tuple[float, float, float]


@dataclass(frozen=True)
class SearchBox:
    """Where the global search looks for the extrinsic: a box around the initial one, in the axes of the camera frame.

    The defaults are those of the configuration stage ``search``; `NOMINAL_BOX` and `SEMANTIC_BOX` are wider.

    Parameters
    ----------
    rotation_deg : float or (float, float, float)
        Half width of the rotation about x, y and z, deg, 0 to 45. 0 = that axis is not searched.
    translation_m : float or (float, float, float)
        Half width of the translation along x, y and z, m, 0 to 3. All six 0 = refine only.
    rounds : int, optional
        Upper limit of the rounds of starts; by default ``search.rounds`` of the configuration.

    Raises
    ------
    ConfigError
        A half width is out of range.
    """

    MAX_DEG: ClassVar[float] = 45.0
    MAX_M: ClassVar[float] = 3.0
    rotation_deg: Axes = SearchConfig.rotation_deg
    translation_m: Axes = SearchConfig.translation_m
    rounds: int | None = None

    def __post_init__(self) -> None:
        for name, high in (("rotation_deg", self.MAX_DEG), ("translation_m", self.MAX_M)):
            value = getattr(self, name)
            try:
                axes = _per_axis(value)
            except (TypeError, ValueError):
                axes = np.full(3, np.nan)
            if not ((axes >= 0) & (axes <= high)).all():  # NaN too
                raise ConfigError(f"SearchBox.{name} = {value!r} is out of range [0, {high:g}]; give a number, or three")

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to search."""
        return not self.half_width().any()

    def scaled(self, share: float, rounds: int) -> SearchBox:
        """One of this share of its size, and so many rounds."""
        (a, b, c), (x, y, z) = (share * _per_axis(half) for half in (self.rotation_deg, self.translation_m))
        return SearchBox((float(a), float(b), float(c)), (float(x), float(y), float(z)), rounds)

    @property
    def reach(self) -> tuple[float, float]:
        """Largest half width in deg and in m."""
        return float(_per_axis(self.rotation_deg).max()), float(_per_axis(self.translation_m).max())

    def half_width(self) -> NDArray[np.float64]:
        """(6,) in rad and m."""
        return np.concatenate([np.deg2rad(_per_axis(self.rotation_deg)), _per_axis(self.translation_m)])


def _per_axis(value: Axes) -> NDArray[np.float64]:
    axes = np.asarray(value, float)
    return np.full(3, axes) if axes.ndim == 0 else axes.reshape(3)


NOMINAL_BOX = SearchBox(10.0, 0.5)  # around the nominal extrinsic: a camera mounted by eye is within this of it
# Around a hypothesis from classes: up to 2.4 deg and 0.95 m off on KITTI, up to 8 deg with half of the labels wrong or missing.
SEMANTIC_BOX = SearchBox(8.0, 1.0)

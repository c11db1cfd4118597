"""Lens models: from rays to the normalised image plane, which K scales to pixels, and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import BadInputError

Floats = NDArray[np.float64]
ANGLES = 4000  # of the table of a lens; steps of at most 0.05 deg
STEP = 1e-6  # rad, of derivatives of the image by the ray
ITERATIONS = 12  # of Newton's method, from a start within such a step but for tangential terms; they end it after 3 to 5
PRECISE, EXACT = 1e-6, 1e-11  # of the image plane: of rays that count as found; where the iteration ends


@dataclass(frozen=True)
class LensModel:
    """names: of the coefficients, in their order. counts: how many may be given. image: (D, rays (n, 3)) -> (n, 2), for rays
    within the domain. domain: D -> angle from the axis, rad, at which the formula ends. within: open intervals of the first
    coefficients. off_radius: places of those that move the image off the radius; all are odd in the position."""

    names: tuple[str, ...]
    counts: tuple[int, ...]
    image: Callable[[Floats, Floats], Floats]
    domain: Callable[[Floats], float]
    within: tuple[tuple[float, float], ...] = ()
    off_radius: tuple[int, ...] = ()


class LensProjection:
    """A lens with its coefficients. limit: the largest angle from the axis, rad, up to which no two rays have one image."""

    def __init__(self, model: str, D: Floats) -> None:
        self.name, self.D = model, D

    @property
    def model(self) -> LensModel:
        """Looked up: functions cannot be copied with a camera."""
        return LENSES[self.name]

    @property
    def limit(self) -> float:
        return float(self._table[0][-1])

    @cached_property
    def slope(self) -> float:
        """Distance on the image plane per rad at the axis: 1 for most models."""
        return float(self.radius(np.array([STEP]))[0] / STEP)

    @cached_property
    def _table(self) -> tuple[Floats, Floats]:
        """Angles from the axis, rad, and distances from the centre, both rising, up to the limit."""
        angle = np.linspace(0, self.model.domain(self.D), ANGLES)
        angle[-1] *= 1 - STEP  # before the pole
        radius = self.radius(angle)
        end = _rises(radius)
        return angle[:end], radius[:end]

    @np.errstate(all="ignore")
    def radius(self, angle: Floats) -> Floats:
        """Distances (n,) from the centre at angles (n,) from the axis, but for what is not along the radius."""
        D = self.D.copy()
        D[[k for k in self.model.off_radius if k < len(D)]] = 0
        return self.model.image(D, np.c_[np.sin(angle), 0 * angle, np.cos(angle)])[:, 0]

    @np.errstate(all="ignore")
    def image(self, rays: Floats, reach: float = np.inf) -> Floats:
        """Rays (n, 3) of any length -> (n, 2) of the image plane; NaN beyond the limit, or beyond the angle `reach`, rad."""
        seen = within(rays, min(self.limit, reach))
        out = np.full((len(rays), 2), np.nan)
        if seen.any():
            out[seen] = self.model.image(self.D, rays[seen])
        return out

    @np.errstate(all="ignore")
    def rays(self, xy: Floats) -> Floats:
        """Unit rays (n, 3) of (n, 2) on the image plane, by Newton's method; NaN where no ray has its image."""
        angle, radius = self._table
        r = np.hypot(xy[:, 0], xy[:, 1])
        at = xy * (np.interp(r, radius, angle) / np.maximum(r, 1e-300))[:, None]  # angles: the direction times that from the axis
        left, error, slope = np.arange(len(xy)), np.full(len(xy), np.inf), np.empty((len(xy), 4))
        for k in range(ITERATIONS):
            # Derivatives are taken inside the limit.
            now = at[left] * np.minimum(1, (self.limit - 2 * STEP) / np.maximum(np.hypot(*at[left].T), 1e-300))[:, None]
            here = self.image(rays_of_angles(now))
            u, v = (here - xy[left]).T
            if k % 3 == 0:  # they change little
                slope = np.hstack([(self.image(rays_of_angles(now + step)) - here) / STEP for step in STEP * np.eye(2)])
            a, c, b, d = slope.T
            change = np.c_[d * u - b * v, a * v - c * u] / (a * d - b * c)[:, None]
            error[left] = np.hypot(u, v)
            at[left] = now
            on = (error[left] > EXACT) & np.isfinite(change).all(axis=1)
            left, slope = left[on], slope[on]
            at[left] -= change[on]
            if not len(left):
                break
        out = rays_of_angles(at)
        out[~(error < PRECISE)] = np.nan
        return out


def within(rays: Floats, angle: float) -> NDArray[np.bool_]:
    """Which rays (n, 3) are at most so far from the axis, rad."""
    x, y, z = rays.T
    if angle >= np.pi / 2:
        return np.asarray(np.arctan2(np.hypot(x, y), z) <= angle)
    return np.asarray((z > 0) & (x * x + y * y <= (z * np.tan(angle)) ** 2))


def angles_of_rays(rays: Floats) -> Floats:
    """Rays (n, 3) of any length -> (n, 2) rad: the angle from the axis, towards x and towards y."""
    r = np.hypot(rays[:, 0], rays[:, 1])
    return np.asarray(rays[:, :2] * (np.arctan2(r, rays[:, 2]) / np.maximum(r, 1e-300))[:, None])


def rays_of_angles(at: Floats) -> Floats:
    """The inverse of `angles_of_rays`: (n, 2) rad -> unit vectors (n, 3)."""
    angle = np.hypot(at[:, 0], at[:, 1])
    return np.asarray(np.c_[at * np.sinc(angle / np.pi)[:, None], np.cos(angle)])


def _opencv(D: Floats, rays: Floats) -> Floats:
    """OpenCV's model of perspective lenses: radial, tangential, rational, thin prism, tilt."""
    if not D[8:].any():  # ten times as fast as OpenCV's own, which also works out derivatives
        k1, k2, p1, p2, k3, k4, k5, k6 = np.r_[D[:8], np.zeros(max(8 - len(D), 0))]
        z = np.where(rays[:, 2] == 0, 1.0, rays[:, 2])
        x, y = rays[:, 0] / z, rays[:, 1] / z
        xy, r2 = 2 * x * y, x * x + y * y
        scale = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if k4 or k5 or k6:
            scale /= 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        return np.asarray(np.c_[x * scale + p1 * xy + p2 * (r2 + 2 * x * x), y * scale + p1 * (r2 + 2 * y * y) + p2 * xy])
    zero = np.zeros(3)
    return np.asarray(cv2.projectPoints(rays[:, None], zero, zero, np.eye(3), D)[0], float).reshape(-1, 2)


def _mei(D: Floats, rays: Floats) -> Floats:
    """C. Mei, P. Rives: Single view point omnidirectional camera calibration from planar grids, 2007."""
    z = rays[:, 2] + D[0] * np.linalg.norm(rays, axis=1)
    return _opencv(D[1:] if len(D) > 1 else np.zeros(4), np.c_[rays[:, :2], z])


def _double_sphere(D: Floats, rays: Floats) -> Floats:
    """V. Usenko et al.: The double sphere camera model, 2018."""
    z = rays[:, 2] + D[0] * np.linalg.norm(rays, axis=1)
    return _eucm(np.array([D[1], 1.0]), np.c_[rays[:, :2], z])


def _eucm(D: Floats, rays: Floats) -> Floats:
    """B. Khomutenko et al.: An enhanced unified camera model, 2016."""
    r, z = np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]
    return np.asarray(rays[:, :2] / (D[0] * np.sqrt(D[1] * r * r + z * z) + (1 - D[0]) * z)[:, None])


def _by_angle(radius: Callable[[Floats, Floats], Floats]) -> Callable[[Floats, Floats], Floats]:
    """The image by the distance from the centre at angles from the axis: (D, angle (n,)) -> (n,)."""

    def image(D: Floats, rays: Floats) -> Floats:
        r = np.hypot(rays[:, 0], rays[:, 1])
        return np.asarray(rays[:, :2] * (radius(D, np.arctan2(r, rays[:, 2])) / np.maximum(r, 1e-300))[:, None])

    return image


def _kannala_brandt(D: Floats, angle: Floats) -> Floats:
    """J. Kannala, S. Brandt, 2006, without their asymmetric terms: r = a (1 + k1 a^2 + k2 a^4 + ...)."""
    return np.asarray(angle * np.polyval([*D[::-1], 1.0], angle * angle))


def _fov(D: Floats, angle: Floats) -> Floats:
    """F. Devernay, O. Faugeras: Straight lines have to be straight, 2001."""
    return np.asarray(np.arctan2(2 * np.sin(angle) * np.tan(D[0] / 2), np.cos(angle)) / D[0])


@np.errstate(all="ignore")
def _division(D: Floats) -> tuple[Floats, Floats]:
    """A. Fitzgibbon: Simultaneous linear estimation of multiple view geometry and lens distortion, 2001: the ray of a point at r
    is (r, 1 + k1 r^2 + k2 r^4 + ...). A table of angles from the axis, up to the limit, and r."""
    r = np.tan(np.linspace(0, np.deg2rad(89.9), 10 * ANGLES))  # between its entries r is straight to 1e-7
    angle = np.arctan2(r, np.polyval([*D[::-1], 1.0], r * r))
    end = _rises(angle)
    return angle[:end], r[:end]


@np.errstate(all="ignore")
def _rises(values: Floats) -> int:
    """How many of the first values (n,) rise for certain: the turn may be just before the last that is higher."""
    falls = np.flatnonzero(~(np.diff(values) > 0))
    return max(int(falls[0]), 1) if len(falls) else len(values)


def _behind(w: float) -> float:
    """The angle from the axis at which z = -w |ray|."""
    return float(np.arccos(np.clip(-w, -1, 1)))


def _lesser(a: float) -> float:
    """w1 of Usenko (eq. 45): up to alpha = 0.5 the image ends at a pole, above where it turns back."""
    return a / (1 - a) if a <= 0.5 else (1 - a) / a


def _double_sphere_domain(D: Floats) -> float:
    xi, w = D[0], _lesser(D[1])
    return _behind((w + xi) / np.sqrt(2 * w * xi + xi * xi + 1))


def _eucm_domain(D: Floats) -> float:
    w = _lesser(D[0])
    return float(np.pi / 2 + np.arctan2(w * np.sqrt(D[1]), np.sqrt(1 - w * w)))


_SPHERE, _SHARE = (-1.0, np.inf), (-1e-9, 1 + 1e-9)
LENSES = {
    "plumb_bob": LensModel(("k1", "k2", "p1", "p2", "k3"), (4, 5), _opencv, lambda D: np.pi / 2, off_radius=(2, 3)),
    "rational_polynomial": LensModel(
        ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty"), (8, 12, 14),
        _opencv, lambda D: np.pi / 2, off_radius=(2, 3, *range(8, 14)),
    ),
    "equidistant": LensModel(tuple(f"k{n}" for n in range(1, 9)), (4, 5, 6, 7, 8), _by_angle(_kannala_brandt), lambda D: np.pi),
    "omnidir": LensModel(
        ("xi", "k1", "k2", "p1", "p2"), (1, 5), _mei, lambda D: _behind(1 / D[0] if D[0] > 1 else D[0]), (_SPHERE,), (3, 4)
    ),
    "double_sphere": LensModel(("xi", "alpha"), (2,), _double_sphere, _double_sphere_domain, (_SPHERE, _SHARE)),
    "eucm": LensModel(("alpha", "beta"), (2,), _eucm, _eucm_domain, (_SHARE, (0.0, np.inf))),
    "ucm": LensModel(("alpha",), (1,), lambda D, rays: _eucm(np.r_[D, 1.0], rays), lambda D: _behind(_lesser(D[0])), (_SHARE,)),
    "fov": LensModel(("w",), (1,), _by_angle(_fov), lambda D: np.pi, ((0.0, np.pi),)),
    "division": LensModel(
        ("k1", "k2", "k3"), (1, 2, 3), _by_angle(lambda D, angle: np.interp(angle, *_division(D))),
        lambda D: float(_division(D)[0][-1]),
    ),
}  # fmt: skip
PERSPECTIVE = ("plumb_bob", "rational_polynomial")  # what OpenCV makes maps for
ALIASES = {
    "plumb_bob": ("", "none", "pinhole", "radtan"),
    "rational_polynomial": ("rational", "radtan8", "thin_prism"),
    "equidistant": ("equi", "fisheye", "kannala_brandt", "kb4", "kb5", "kb6", "kb7", "kb8"),
    "omnidir": ("mei", "omni", "omni_radtan", "unified"),
    "double_sphere": ("ds",),
    "eucm": ("extended_unified",),
    "fov": ("atan",),
}
_MODEL_OF = {alias: model for model, aliases in ALIASES.items() for alias in aliases}


def lens_model(name: str) -> str:
    """The name in LENSES of a model as ROS, Kalibr, basalt, OpenCV and others call it; lower case if it is none."""
    plain = "_".join(name.lower().replace("-", " ").split()).removeprefix("pinhole_").removesuffix("_none")
    return _MODEL_OF.get(plain, plain)


def refuse(model: str, D: Floats) -> None:
    """BadInputError if coefficients (n,), not all 0, are no lens of a model."""
    own = LENSES.get(model)
    if own is None or len(D) not in own.counts:
        expected = " or ".join(map(str, own.counts)) if own else "no"
        raise BadInputError(f"CameraInfo: {model} has {expected} distortion coefficients, got {len(D)}")
    for name, value, (low, high) in zip(own.names, D, own.within, strict=False):
        if not low < value < high:
            raise BadInputError(f"CameraInfo: {model}: {name} = {value:g} is not between {low:g} and {high:g}; calibrate again")

"""Camera models of ROS (sensor_msgs/CameraInfo), the projection of eq. 2.1-2.3, and rectification."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros.errors import BadInputError

# Model -> allowed numbers of coefficients in ROS and OpenCV.
DISTORTION_MODELS: dict[str, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (0, 8, 12, 14),
    "equidistant": (0, 4),
}
ALIASES = {
    "": "plumb_bob",
    "none": "plumb_bob",
    "radtan": "plumb_bob",
    "pinhole": "plumb_bob",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
}
NOISE = 1e-9  # of the largest element of K, that may be left where 0 should be
MAX_SKEW_PX = 0.5  # of a pixel at the image's border, which no edge shows; OpenCV has none in its models
MAX_SIDE = 32766  # px; OpenCV cannot rectify larger images
MIN_DEPTH = 0.1  # m; nearer points are out of focus, and 1/z diverges
SPHERE = "sphere"  # model of images whose radius is the angle from the axis; not a lens, but what wide ones are shown on
WIDEST = np.deg2rad(140.0)  # rad from the axis to which images are unrolled: no lens sees farther


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera, with the distortion models of sensor_msgs/CameraInfo.

    Parameters
    ----------
    K : (3, 3), px. width, height : of the image, px, at most 32766 each.
    model : ``plumb_bob``, ``rational_polynomial`` or ``equidistant``; some other names of the same models are understood.
    D : (n,) distortion coefficients in ROS order; empty or all zero = a pinhole camera.

    Raises BadInputError if K is no camera matrix, the size is out of range, or D does not fit the model.
    """

    K: NDArray[np.float64]
    width: int
    height: int
    model: str = "plumb_bob"
    D: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        K = np.array(self.K, float)
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise BadInputError("CameraInfo: K must be a finite 3x3 matrix")
        if K[0, 0] <= 0 or K[1, 1] <= 0:
            raise BadInputError(
                f"CameraInfo: focal lengths fx={K[0, 0]:g}, fy={K[1, 1]:g} must be positive; "
                "calibrate the camera's intrinsics first"
            )
        skew = abs(K[0, 1]) * self.height / K[1, 1]
        lower = np.tril(K, -1)
        if skew > MAX_SKEW_PX or np.abs(lower).max() > NOISE * np.abs(K).max():
            why = (
                f"its skew moves pixels by {skew:.1f} px; rectify the images" if skew > MAX_SKEW_PX else "its lower left is not 0"
            )
            raise BadInputError(f"CameraInfo: K must be [fx 0 cx; 0 fy cy; 0 0 1], but {why}")
        K -= lower
        K[0, 1] = 0.0
        if self.width <= 0 or self.height <= 0:
            raise BadInputError(f"CameraInfo: image size {self.width}x{self.height} must be positive")
        if max(self.width, self.height) > MAX_SIDE:
            raise BadInputError(
                f"CameraInfo: image size {self.width}x{self.height} is beyond {MAX_SIDE} px a side; check the camera driver"
            )
        model = ALIASES.get(self.model.lower(), self.model.lower())
        if model not in DISTORTION_MODELS and model != SPHERE:
            raise BadInputError(
                f"CameraInfo: distortion model '{' '.join(self.model.split())[:80]}' is not supported; "
                f"rectify the image or use one of {', '.join(DISTORTION_MODELS)}"
            )
        D = np.array(self.D, float).ravel()
        if not np.isfinite(D).all():
            raise BadInputError("CameraInfo: distortion coefficients must be finite")
        if not D.any():
            D = np.zeros(0)
        if len(D) not in DISTORTION_MODELS.get(model, (0,)):
            expected = " or ".join(str(n) for n in DISTORTION_MODELS.get(model, ()) if n) or "no"
            raise BadInputError(f"CameraInfo: {model} has {expected} distortion coefficients, got {len(D)}")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "D", D)
        object.__setattr__(self, "model", model)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Camera):
            return NotImplemented
        return (
            (self.width, self.height, self.model) == (other.width, other.height, other.model)
            and np.allclose(self.K, other.K, rtol=1e-9, atol=1e-9)
            and self.D.shape == other.D.shape
            and np.allclose(self.D, other.D, rtol=1e-9, atol=1e-12)
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def is_pinhole(self) -> bool:
        """Whether there is no distortion: the image is rectified, or the lens ideal."""
        return len(self.D) == 0 and not self.is_sphere

    @property
    def is_sphere(self) -> bool:
        """Whether the radius is the angle from the axis: u = fx a x / r + cx, v = fy a y / r + cy, where r = hypot(x, y) and
        a = atan2(r, z)."""
        return self.model == SPHERE

    def project(self, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Points (n, 3) in the camera's optical frame, m -> pixels (n, 2) and whether each is in the image (n,).

        Pixel centres are at integers. Points behind the camera are NaN; so are points outside the field of view of the lens,
        where distortion polynomials fold back into the image.
        """
        P = np.atleast_2d(np.asarray(points, float)).reshape(-1, 3)
        uv = np.full((len(P), 2), np.nan)
        front = (np.linalg.norm(P, axis=1) if self.is_sphere else P[:, 2]) > MIN_DEPTH
        if self.is_sphere:
            uv[front] = angles_from_axis(P[front]) @ self.K[:2, :2].T + self.K[:2, 2]
        elif self.is_pinhole:
            x = P[front, :2] / P[front, 2:]
            uv[front] = x @ self.K[:2, :2].T + self.K[:2, 2]
        else:
            radius = np.hypot(P[:, 0], P[:, 1])
            with np.errstate(divide="ignore", invalid="ignore"):
                front &= radius <= self._field_radius * P[:, 2]
            if front.any():
                uv[front] = self._distort(P[front])
        with np.errstate(invalid="ignore"):
            inside = (uv[:, 0] >= 0) & (uv[:, 0] <= self.width - 1) & (uv[:, 1] >= 0) & (uv[:, 1] <= self.height - 1)
        return uv, inside

    def _lens_pixels(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """As `project`, pixels (n, 2) of rays (n, 3), also of those behind the image plane that a fisheye sees."""
        if self.model != "equidistant" or self.is_pinhole:
            return self.project(rays)[0]
        x, y, z = rays.T
        r = np.hypot(x, y)
        angle = np.arctan2(r, z)
        powers = angle[:, None] ** np.array([3, 5, 7, 9])
        radius = angle + powers @ self.D
        uv = (np.c_[x, y] * (radius / np.maximum(r, 1e-12))[:, None]) @ self.K[:2, :2].T + self.K[:2, 2]
        uv[angle > self._fold_angle] = np.nan
        return np.asarray(uv)

    @cached_property
    def _fold_angle(self) -> float:
        """Angle from the axis, rad, at which a fisheye's radius stops growing; pi if it never does."""
        angle = np.linspace(0, np.pi, 4000)
        grows = 1 + angle[:, None] ** np.array([2, 4, 6, 8]) @ (self.D * [3, 5, 7, 9]) > 0
        return float(np.pi if grows.all() else angle[np.argmin(grows)])

    def _distort(self, P: NDArray[np.float64]) -> NDArray[np.float64]:
        zero = np.zeros(3)
        if self.model == "equidistant":
            uv, _ = cv2.fisheye.projectPoints(P[:, None], zero, zero, self.K, self.D)
        else:
            uv, _ = cv2.projectPoints(P[:, None], zero, zero, self.K, self.D)
        return np.asarray(uv).reshape(-1, 2)

    @cached_property
    def _field_radius(self) -> float:
        """Largest tan(angle from the axis) in the image, plus 10 %, at which the distortion does not fold back."""
        undistort: Any = cv2.fisheye.undistortPoints if self.model == "equidistant" else cv2.undistortPoints
        rays = np.asarray(undistort(self._border()[:, None], self.K, self.D)).reshape(-1, 2)
        radius = np.hypot(rays[:, 0], rays[:, 1])
        radius = radius[np.isfinite(radius) & (radius < 1e3)]
        return min(1.1 * float(radius.max()) if len(radius) else 20.0, self._fold_radius())

    def _fold_radius(self) -> float:
        """The tan(angle from the axis) at which the radial distortion stops growing; inf if it never does."""
        radius = np.tan(np.linspace(0, np.deg2rad(89.5), 4000))
        radial = self.D.copy()
        if self.model != "equidistant":
            radial[2:4] = 0  # the tangential terms
        lens = replace(self, K=np.eye(3), D=radial)
        grows = np.diff(lens._distort(np.c_[radius, 0 * radius, np.ones_like(radius)])[:, 0]) > 0
        return float("inf") if grows.all() else float(radius[np.argmin(grows)])

    def _border(self) -> NDArray[np.float64]:
        """Pixels (132, 2) along the border of the image."""
        w, h = self.width - 1, self.height - 1
        t = np.linspace(0, 1, 33)
        return np.concatenate([np.c_[t * w, 0 * t], np.c_[t * w, 0 * t + h], np.c_[0 * t, t * h], np.c_[0 * t + w, t * h]])

    def rectified(self) -> Camera:
        """The pinhole camera of the rectified image: same size, with K such that the image has no empty border."""
        if self.is_pinhole:
            return self
        size = (self.width, self.height)
        if self.model == "equidistant":
            K = self._central_field()
        else:
            K, _ = cv2.getOptimalNewCameraMatrix(self.K, self.D, size, 0.0, size)
        return Camera(np.asarray(K, float), self.width, self.height)

    @cached_property
    def field_deg(self) -> float:
        """Degrees from the left to the right border of the image, in the row and on either side of the optical axis."""
        left, right = self._sides()
        return float(np.rad2deg(right - left))

    def _sides(self) -> tuple[float, float]:
        """Angles (rad) from the optical axis of the left and the right border, at most WIDEST to either side."""
        angle = np.linspace(-WIDEST, WIDEST, 561)
        return _range_inside(angle, self._lens_pixels(np.c_[np.sin(angle), 0 * angle, np.cos(angle)])[:, 0], self.width)

    def unrolled(self) -> Camera:
        """The camera of the image on a sphere about the camera, of all that the lens sees, at its own focal length."""
        # 60 deg from the axis a pinhole stretches the image four times: one blur is not the same angle everywhere.
        around, angle = np.meshgrid(np.linspace(0, 2 * np.pi, 361), np.linspace(0, WIDEST, 561))
        at = np.stack([angle * np.cos(around), angle * np.sin(around)], axis=-1).reshape(-1, 2)
        u, v = self._lens_pixels(rays_of_angles(at)).T
        with np.errstate(invalid="ignore"):
            seen = at[(u >= 0) & (u <= self.width - 1) & (v >= 0) & (v <= self.height - 1)]
        first, last, focal = seen.min(axis=0, initial=0.0), seen.max(axis=0, initial=0.0), np.diag(self.K)[:2]
        width, height = (max(round(size), 1) for size in focal * (last - first))
        K = np.array([[focal[0], 0, -focal[0] * first[0]], [0, focal[1], -focal[1] * first[1]], [0, 0, 1]])
        return Camera(K, width, height, SPHERE)

    def angles(self) -> NDArray[np.float64]:
        """Of a sphere, the angles (H, W, 2) rad from the axis of each pixel, see `angles_from_axis`."""
        u, v = ((np.arange(size) - self.K[k, 2]) / self.K[k, k] for k, size in enumerate((self.width, self.height)))
        return np.stack(np.meshgrid(u, v), axis=-1)

    def _central_field(self) -> NDArray[np.float64]:
        """K (3, 3) of a fisheye's central field: of the shortest focal length, from 0.8 times the lens's, without empty rim."""
        # OpenCV's estimate tries the whole field: a tenth of the focal length, and principal points outside the image.
        edge, focal = self._border(), 0.8 * float(min(self.K[0, 0], self.K[1, 1]))
        for _ in range(40):
            rays = np.c_[(edge - self.K[:2, 2]) / focal, np.ones(len(edge))]
            if self.project(rays)[1].all():
                break
            focal *= 1.05
        return np.array([[focal, 0, self.K[0, 2]], [0, focal, self.K[1, 2]], [0, 0, 1]])


def angles_from_axis(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rays (n, 3) of any length, the optical axis z -> (n, 2) rad: the angle from the axis, towards x and towards y."""
    radius = np.hypot(rays[:, 0], rays[:, 1])
    return np.asarray(rays[:, :2] * (np.arctan2(radius, rays[:, 2]) / np.maximum(radius, 1e-12))[:, None])


def rays_of_angles(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of `angles_from_axis`: (n, 2) rad -> unit vectors (n, 3)."""
    angle = np.hypot(angles[:, 0], angles[:, 1])
    return np.asarray(np.c_[angles * np.sinc(angle / np.pi)[:, None], np.cos(angle)])


def across_meridians(sphere: Camera) -> NDArray[np.float64]:
    """Unit vectors (2, H, W) of a sphere's picture, at every pixel normal to the image of the line there that is parallel to the
    camera's y axis: to the meridian, whose poles are above and below."""
    x, y, z = rays_of_angles(sphere.angles().reshape(-1, 2) + 1e-9).T  # on the axis itself there is no direction outward
    radius = np.hypot(x, y)
    # d/de of the ray at elevation e: along the radius, and around the axis, where the picture is stretched by angle / sine.
    level = np.maximum(np.hypot(x, z), 1e-12)
    upward = np.stack([-y * x / level, level, -y * z / level])
    outward = ((x * upward[0] + y * upward[1]) * z / radius) - radius * upward[2]
    around = (x * upward[1] - y * upward[0]) / radius * (np.arctan2(radius, z) / radius)
    u = sphere.K[0, 0] * (outward * x - around * y) / radius
    v = sphere.K[1, 1] * (outward * y + around * x) / radius
    return np.asarray(np.stack([v, -u]) / np.maximum(np.hypot(u, v), 1e-12)).reshape(2, sphere.height, sphere.width)


def _range_inside(values: NDArray[np.float64], pixel: NDArray[np.float64], size: int) -> tuple[float, float]:
    """Least and largest of the values (n,) whose pixel (n,) is one of the image's `size`."""
    with np.errstate(invalid="ignore"):
        inside = (pixel >= 0) & (pixel <= size - 1)
    return float(values[inside].min(initial=0.0)), float(values[inside].max(initial=0.0))


class Rectifier:
    """Removes lens distortion from images; look-up tables are made once, with the first image. target: camera of the rectified
    image, a pinhole or a sphere; None = ``camera.rectified()``."""

    def __init__(self, camera: Camera, target: Camera | None = None) -> None:
        self.source = camera
        self.camera = target or camera.rectified()

    @cached_property
    def _maps(self) -> tuple[Any, Any]:
        lens, size = self.source, (self.source.width, self.source.height)
        if self.camera.is_sphere:
            at = np.nan_to_num(self._pixels, nan=-1.0)
            return cv2.convertMaps(at[..., 0], at[..., 1], cv2.CV_16SC2)
        init: Any = cv2.fisheye.initUndistortRectifyMap if lens.model == "equidistant" else cv2.initUndistortRectifyMap
        maps: tuple[Any, Any] = init(lens.K, lens.D, np.eye(3), self.camera.K, size, cv2.CV_16SC2)
        return maps

    @cached_property
    def _pixels(self) -> NDArray[np.float32]:
        """Pixel (H, W, 2) of the lens that each pixel of a sphere shows; NaN = none."""
        uv = self.source._lens_pixels(rays_of_angles(self.camera.angles().reshape(-1, 2)))
        return np.asarray(uv.reshape(self.camera.height, self.camera.width, 2), np.float32)

    def seen(self) -> NDArray[np.bool_] | None:
        """Pixels (H, W) of the rectified image that the lens shows; None = all but slivers along the border."""
        if not self.camera.is_sphere:
            return None
        size = np.array([self.source.width - 1, self.source.height - 1])
        with np.errstate(invalid="ignore"):
            return np.asarray(((self._pixels >= 0) & (self._pixels <= size)).all(axis=2))

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Image (H, W[, 3]) as recorded -> rectified; of the same shape on a pinhole."""
        return np.asarray(self.map(image), np.uint8)

    def map(self, values: NDArray[Any], nearest: bool = False) -> NDArray[Any]:
        """Values of pixels (H, W[, channels]) of any type of OpenCV, rectified. nearest: not interpolated."""
        if self.camera is self.source or (self.source.is_pinhole and self.camera.is_pinhole):
            return values
        between = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        # Border pixels are repeated: a fisheye's K leaves slivers of 1-3 px without image, and black ones would be edges.
        return np.asarray(cv2.remap(values, *self._maps, between, borderMode=cv2.BORDER_REPLICATE))

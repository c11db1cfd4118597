"""Camera models of ROS (sensor_msgs/CameraInfo), the projection of eq. 2.1-2.3, and rectification."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_ros.errors import BadInputError
from calib_ros.lens import LENSES, PERSPECTIVE, LensProjection, angles_of_rays, lens_model, rays_of_angles, refuse

NOISE = 1e-9  # of the largest element of K, that may be left where 0 should be
MAX_SKEW_PX = 0.5  # of a pixel at the image's border, which no edge shows; OpenCV has none in its models
MAX_SIDE = 32766  # px; OpenCV cannot rectify larger images
MIN_DEPTH = 0.1  # m; nearer points are out of focus, and 1/z diverges
SPHERE = "sphere"  # model of images whose radius is the angle from the axis; not a lens, but what wide ones are shown on
WIDEST = np.deg2rad(140.0)  # rad from the axis to which images are unrolled: no lens sees farther


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera, with the distortion models of sensor_msgs/CameraInfo and others, see `calib_ros.lens`.

    Parameters
    ----------
    K : (3, 3), px. width, height : of the image, px, at most 32766 each.
    model : a name in LENSES; the names of ROS, Kalibr, basalt and OpenCV are understood.
    D : (n,) distortion coefficients in the model's order, which is that of ROS; empty or all zero = a pinhole camera.
    said_rectified : the image is taken for rectified although its CameraInfo has a distortion: it may be raw. Not compared.

    Raises BadInputError if K is no camera matrix, the size is out of range, or D does not fit the model.
    """

    K: NDArray[np.float64]
    width: int
    height: int
    model: str = "plumb_bob"
    D: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    said_rectified: bool = False

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
        model = lens_model(self.model)
        if model not in LENSES and model != SPHERE:
            raise BadInputError(
                f"CameraInfo: distortion model '{' '.join(self.model.split())[:80]}' is not supported; "
                f"rectify the image or use one of {', '.join(LENSES)}"
            )
        D = np.array(self.D, float).ravel()
        if not np.isfinite(D).all():
            raise BadInputError("CameraInfo: distortion coefficients must be finite")
        if D.any():
            refuse(model, D)
        else:
            D, model = np.zeros(0), model if model in (*PERSPECTIVE, "equidistant", SPHERE) else "plumb_bob"
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
        uv = self._lens_pixels(P)
        uv[~((np.linalg.norm(P, axis=1) if self.is_sphere else P[:, 2]) > MIN_DEPTH)] = np.nan
        with np.errstate(invalid="ignore"):
            inside = (uv[:, 0] >= 0) & (uv[:, 0] <= self.width - 1) & (uv[:, 1] >= 0) & (uv[:, 1] <= self.height - 1)
        return uv, inside

    def _lens_pixels(self, rays: NDArray[np.float64]) -> NDArray[np.float64]:
        """As `project`, pixels (n, 2) of rays (n, 3), also of those behind the image plane that a fisheye sees."""
        with np.errstate(all="ignore"):
            if self.is_sphere:
                xy = angles_of_rays(rays)
            elif self.is_pinhole:
                xy = np.where(rays[:, 2:] > 0, rays[:, :2] / rays[:, 2:], np.nan)
            else:
                xy = self._lens.image(rays, self._reach)
            return np.asarray(xy @ self.K[:2, :2].T + self.K[:2, 2])

    def unproject(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """Unit rays (n, 3) of pixels (n, 2), also of those outside the image; NaN where the lens shows nothing."""
        xy = (np.asarray(pixels, float).reshape(-1, 2) - self.K[:2, 2]) / np.diag(self.K)[:2]
        if self.is_pinhole:
            rays = np.c_[xy, np.ones(len(xy))]
            return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
        return rays_of_angles(xy) if self.is_sphere else self._lens.rays(xy)

    @cached_property
    def _lens(self) -> LensProjection:
        return LensProjection(self.model, self.D)

    @property
    def focal(self) -> NDArray[np.float64]:
        """(2,) px per rad at the optical axis: fx and fy of K, but for models that scale there."""
        return np.diag(self.K)[:2] * (1.0 if self.is_pinhole or self.is_sphere else self._lens.slope)

    @cached_property
    def _reach(self) -> float:
        """Angle from the axis, rad, up to which points are projected: of the image's border, the tangent plus 10 %."""
        # What does not move along the radius may fold back before the limit of the lens, which is that of the radius.
        angle = np.arccos(self.unproject(self._border())[:, 2]).max()
        return float(np.arctan(1.1 * np.tan(angle))) if angle < np.pi / 2 else np.inf

    def _border(self) -> NDArray[np.float64]:
        """Pixels (132, 2) along the border of the image."""
        w, h = self.width - 1, self.height - 1
        t = np.linspace(0, 1, 33)
        return np.concatenate([np.c_[t * w, 0 * t], np.c_[t * w, 0 * t + h], np.c_[0 * t, t * h], np.c_[0 * t + w, t * h]])

    def rectified(self) -> Camera:
        """The pinhole camera of the rectified image: same size, with K such that the image has no empty border."""
        if self.is_pinhole:
            return self
        if self.model in PERSPECTIVE:
            size = (self.width, self.height)
            K, _ = cv2.getOptimalNewCameraMatrix(self.K, self.D, size, 0.0, size)
            return Camera(np.asarray(K, float), self.width, self.height)
        # A wide lens's central field, of the shortest focal length, from 0.8 times the lens's, without empty rim. OpenCV tries
        # the whole field: a tenth of the focal length, and principal points outside the image.
        edge, focal = self._border(), 0.8 * float(min(self.focal))
        for _ in range(40):
            rays = np.c_[(edge - self.K[:2, 2]) / focal, np.ones(len(edge))]
            pixels, inside = self.project(rays)
            if inside.all():
                break
            focal *= 1.05
        else:
            if np.isnan(pixels).any():
                raise BadInputError("CameraInfo: the lens shows next to nothing of what is ahead; calibrate again")
        return Camera(np.array([[focal, 0, self.K[0, 2]], [0, focal, self.K[1, 2]], [0, 0, 1]]), self.width, self.height)

    @cached_property
    def field_deg(self) -> float:
        """Degrees from the left to the right border of the image, in the row and on either side of the optical axis."""
        angle = np.linspace(-WIDEST, WIDEST, 561)
        pixel = self._lens_pixels(np.c_[np.sin(angle), 0 * angle, np.cos(angle)])[:, 0]
        with np.errstate(invalid="ignore"):
            seen = angle[(pixel >= 0) & (pixel <= self.width - 1)]
        return float(np.rad2deg(float(seen.max(initial=0.0)) - float(seen.min(initial=0.0))))

    def unrolled(self) -> Camera:
        """The camera of the image on a sphere about the camera, of all that the lens sees, at its own focal length."""
        # 60 deg from the axis a pinhole stretches the image four times: one blur is not the same angle everywhere.
        around, angle = np.meshgrid(np.linspace(0, 2 * np.pi, 181), np.linspace(0, WIDEST, 281))
        at = np.stack([angle * np.cos(around), angle * np.sin(around)], axis=-1).reshape(-1, 2)
        u, v = self._lens_pixels(rays_of_angles(at)).T
        with np.errstate(invalid="ignore"):
            seen = at[(u >= 0) & (u <= self.width - 1) & (v >= 0) & (v <= self.height - 1)]
        first, last, (fx, fy) = seen.min(axis=0, initial=0.0), seen.max(axis=0, initial=0.0), self.focal
        width, height = (max(round(float(size)), 1) for size in (last - first) * [fx, fy])
        return Camera(np.array([[fx, 0, -fx * first[0]], [0, fy, -fy * first[1]], [0, 0, 1]]), width, height, SPHERE)


def across_meridians(sphere: Camera) -> NDArray[np.float64]:
    """Unit vectors (2, H, W) of a sphere's picture, at every pixel normal to the image of the line there that is parallel to the
    camera's y axis: to the meridian, whose poles are above and below."""
    grid = np.stack(np.meshgrid(np.arange(sphere.width), np.arange(sphere.height)), axis=-1)
    x, y, z = sphere.unproject(grid + 1e-6).T  # on the axis itself there is no direction outward
    radius = np.hypot(x, y)
    # d/de of the ray at elevation e: along the radius, and around the axis, where the picture is stretched by angle / sine.
    level = np.maximum(np.hypot(x, z), 1e-12)
    upward = np.stack([-y * x / level, level, -y * z / level])
    outward = ((x * upward[0] + y * upward[1]) * z / radius) - radius * upward[2]
    around = (x * upward[1] - y * upward[0]) / radius * (np.arctan2(radius, z) / radius)
    u = sphere.K[0, 0] * (outward * x - around * y) / radius
    v = sphere.K[1, 1] * (outward * y + around * x) / radius
    return np.asarray(np.stack([v, -u]) / np.maximum(np.hypot(u, v), 1e-12)).reshape(2, sphere.height, sphere.width)


class Rectifier:
    """Removes lens distortion from images; look-up tables are made once, with the first image. target: camera of the rectified
    image, a pinhole or a sphere; None = ``camera.rectified()``."""

    def __init__(self, camera: Camera, target: Camera | None = None) -> None:
        self.source = camera
        self.camera = target or camera.rectified()

    @cached_property
    def _maps(self) -> tuple[Any, Any]:
        lens, target = self.source, self.camera
        fisheye = lens.model == "equidistant" and len(lens.D) == 4
        if target.is_sphere or not (fisheye or lens.model in PERSPECTIVE):
            at = np.nan_to_num(self._pixels, nan=-1.0)
            return cv2.convertMaps(at[..., 0], at[..., 1], cv2.CV_16SC2)
        init: Any = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
        maps: tuple[Any, Any] = init(lens.K, lens.D, np.eye(3), target.K, (lens.width, lens.height), cv2.CV_16SC2)
        return maps

    @cached_property
    def _pixels(self) -> NDArray[np.float32]:
        """Pixel (H, W, 2) of the lens that each pixel of the target shows; NaN = none, and ±MAX_SIDE are beyond any image."""
        columns, rows = np.arange(self.camera.width), np.arange(self.camera.height)
        out = np.empty((len(rows), len(columns), 2), np.float32)
        for part in np.array_split(rows, max(1, out.size >> 19)):  # bounds the memory of what is between
            uv = np.stack(np.meshgrid(columns, part), axis=-1)
            out[part] = np.clip(self.source._lens_pixels(self.camera.unproject(uv)), -MAX_SIDE, MAX_SIDE).reshape(uv.shape)
        return out

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

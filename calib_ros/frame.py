"""Frame (an image and a point cloud), PointCloud and SemanticClass, the data that all other modules work on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.errors import BadInputError

NANOSECONDS = 1_000_000_000
MAX_COORDINATE = 1e5  # m; beyond the range of any LiDAR; squares of larger numbers do not fit float32


class SemanticClass(IntEnum):
    """Class of a point or a pixel."""

    OTHER = 0  # known to be none of the others
    VEHICLE = 1
    PERSON = 2
    CYCLIST = 3  # two-wheelers and their riders
    POLE = 4
    SIGN = 5  # traffic signs and lights
    BUILDING = 6
    VEGETATION = 7
    GROUND = 8
    SKY = 9


UNLABELLED = 255  # class unknown; in arrays of classes (uint8)
# The important classes of eq. 3.16: vehicle, pedestrian, cyclist, pole, traffic sign and light.
MAIN_CLASSES = (SemanticClass.VEHICLE, SemanticClass.PERSON, SemanticClass.CYCLIST, SemanticClass.POLE, SemanticClass.SIGN)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """A LiDAR scan in the LiDAR frame, in the order of the source. BadInputError if the shapes do not match.

    Parameters
    ----------
    xyz : (n, 3) float32, m; NaN for no return.
    intensity : (n,) float32, in the source's own unit. ring : (n,) int32, number of the laser.
    time : (n,) float32, s after the scan's stamp.
    label : (n,) uint8, `SemanticClass` of each point, ``UNLABELLED`` where unknown.
    time_problem : for people, why the source's point times are not used; "" if they are, or if it has none.
    """

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32] | None = None
    ring: NDArray[np.int32] | None = None
    time: NDArray[np.float32] | None = None
    label: NDArray[np.uint8] | None = None
    time_problem: str = ""

    def __post_init__(self) -> None:
        if self.xyz.ndim != 2 or self.xyz.shape[1] != 3:
            raise BadInputError(f"a point cloud needs xyz of shape (n, 3), got {self.xyz.shape}")
        for name in ("intensity", "ring", "time", "label"):
            values = getattr(self, name)
            if values is not None and values.shape != (len(self.xyz),):
                raise BadInputError(f"{name} has shape {values.shape}, but the cloud has {len(self.xyz)} points")

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, mask: NDArray[np.bool_] | NDArray[np.intp]) -> PointCloud:
        """The points of a mask (n,) or index array, with all fields."""
        chosen = {name: v[mask] for name in ("intensity", "ring", "time", "label") if (v := getattr(self, name)) is not None}
        return replace(self, xyz=self.xyz[mask], **chosen)

    def finite(self) -> PointCloud:
        """Without points that are NaN, too far for any LiDAR, or at the origin (which is how drivers mark lost returns)."""
        keep = self.finite_mask()
        return self if keep.all() else self.select(keep)

    def finite_mask(self) -> NDArray[np.bool_]:
        """Mask (n,) of the points that `finite` keeps; not to be written to."""
        return self._finite

    @cached_property
    def _finite(self) -> NDArray[np.bool_]:
        # Every scan is asked twice; column by column takes a fifth of the time of all() and any() over rows of three.
        x, y, z = np.abs(np.ascontiguousarray(self.xyz.T))
        near = (x < MAX_COORDINATE) & (y < MAX_COORDINATE) & (z < MAX_COORDINATE)
        return np.asarray(near & ((x > 1e-6) | (y > 1e-6) | (z > 1e-6)))


@dataclass(frozen=True, eq=False)
class Frame:
    """One synchronised image and point cloud.

    Parameters
    ----------
    image : (H, W, 3) BGR or (H, W) grey uint8, as recorded (distorted if the camera is).
    camera : intrinsics of this image.
    stamp : of the image, ns. cloud_stamp : of the cloud, ns; by default that of the image.
    reference : T_camera_lidar (4, 4), if the source knows it.
    name : of the frame in its source.
    twist : (6,) velocity of the LiDAR (rx, ry, rz, tx, ty, tz), rad/s and m/s, in its own frame at the cloud's stamp; None =
        unknown.
    compensated : whether the points are already motion-compensated to the cloud's stamp.
    classes : (H, W) uint8, `SemanticClass` of each pixel, ``UNLABELLED`` where unknown, if the source knows them.

    Raises BadInputError if the image is not uint8 of one or three channels, or its size is not the camera's, or shapes do not
    match.
    """

    image: NDArray[np.uint8]
    cloud: PointCloud
    camera: Camera
    stamp: int = 0
    cloud_stamp: int | None = None
    reference: NDArray[np.float64] | None = None
    name: str = ""
    twist: NDArray[np.float64] | None = None
    compensated: bool = False
    classes: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        if self.twist is not None:
            try:
                twist = np.array(self.twist, float)
            except (TypeError, ValueError):
                twist = np.zeros(0)
            if twist.shape != (6,) or not np.isfinite(twist).all():
                raise BadInputError(
                    f"frame {self.name or self.stamp}: a twist must be 6 finite numbers (rx, ry, rz in rad/s, tx, ty, tz in "
                    f"m/s), got {self.twist!r}"
                )
            object.__setattr__(self, "twist", twist)
        if self.classes is not None and self.classes.shape != self.image.shape[:2]:
            raise BadInputError(f"the classes of the pixels are {self.classes.shape}, the image is {self.image.shape[:2]}")
        shape_fits = self.image.ndim == 2 or (self.image.ndim == 3 and self.image.shape[2] == 3)
        if self.image.dtype != np.uint8 or not shape_fits or self.image.size == 0:
            raise BadInputError(
                f"an image must be non-empty uint8 (H, W) or (H, W, 3), got {self.image.dtype} {self.image.shape}"
            )
        height, width = self.image.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise BadInputError(
                f"the image is {width}x{height}, but its CameraInfo says {self.camera.width}x{self.camera.height}; "
                "use the CameraInfo that belongs to this image topic"
            )

    @property
    def moment_of_cloud(self) -> int:
        """Stamp of the cloud in ns: its own, else the image's."""
        return self.stamp if self.cloud_stamp is None else self.cloud_stamp

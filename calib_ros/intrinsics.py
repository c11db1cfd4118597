"""What the scenes tell of a camera's intrinsics: estimates of single ones, and the camera that is corrected by all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import yaml

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError

# Names in files. The aspect is that of fy, the focal length that of fx.
FOCAL, ASPECT, RADIAL = "focal_length_share", "aspect_share", "k1"
CENTRE = ("principal_point_x_px", "principal_point_y_px")
NAMES = (FOCAL, ASPECT, *CENTRE, RADIAL)
COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}  # of a camera that had none, as ROS writes them


@dataclass(frozen=True)
class IntrinsicEstimate:
    """What the scenes tell of an intrinsic parameter, as a change of the given value.

    value: where they match best. sigma: its standard deviation by them alone, inf where they do not show it. observable: they
    tell more of it than was known in advance.
    """

    value: float
    sigma: float
    observable: bool

    def to_dict(self) -> dict[str, Any]:
        """For files: null for no standard deviation."""
        return {**asdict(self), "sigma": self.sigma if math.isfinite(self.sigma) else None}


@dataclass(frozen=True, eq=False)
class RefinedCamera:
    """A camera whose intrinsics are estimated together with the extrinsic.

    camera: the corrected one. T_camera_lidar: (4, 4) that belongs to it. changes: by name, each against the camera of the frames,
    with the standard deviation by scenes and what is known in advance. covariance: (6 + n, 6 + n) of a left twist of the
    extrinsic, rad and m, and of the changes, in their units and order.
    """

    camera: Camera
    T_camera_lidar: Transform
    changes: Mapping[str, IntrinsicEstimate]
    covariance: Matrix

    @property
    def settled(self) -> bool:
        """Whether no change is left that can be told from none."""
        return all(abs(change.value) <= change.sigma for change in self.changes.values())

    @property
    def directions(self) -> Matrix:
        """(6, n) twist of the extrinsic, rad and m, per unit of each change."""
        own = self.covariance[6:, 6:]
        sigma = np.sqrt(np.diag(own))
        whitened = np.linalg.solve(own / np.outer(sigma, sigma), self.covariance[6:, :6] / sigma[:, None])
        return np.asarray(whitened.T / sigma)

    def to_dict(self) -> dict[str, Any]:
        """The entry of the result format, see docs/result.md."""
        camera = self.camera
        return {
            "width": camera.width,
            "height": camera.height,
            "distortion_model": camera.model,
            "K": camera.K.tolist(),
            "D": camera.D.tolist(),
            "T_camera_lidar": self.T_camera_lidar.tolist(),
            "changes": {name: change.to_dict() for name, change in self.changes.items()},
            "joint_covariance": self.covariance.tolist(),
        }

    @staticmethod
    def from_dict(data: Any, what: str) -> RefinedCamera:
        """The same from a file. BadInputError names `what`."""
        try:
            camera = Camera(
                np.array(data["K"], float), int(data["width"]), int(data["height"]), str(data["distortion_model"]),
                np.array(data["D"], float),
            )  # fmt: skip
            changes = {
                str(name): IntrinsicEstimate(
                    float(own["value"]), math.inf if own["sigma"] is None else float(own["sigma"]), bool(own["observable"])
                )
                for name, own in data["changes"].items()
            }
            covariance = np.array(data["joint_covariance"], float)
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError):
            raise BadInputError(
                f"{what}: refined_camera must hold width, height, distortion_model, K, D, T_camera_lidar, changes and "
                "joint_covariance, or be null"
            ) from None
        except BadInputError as error:
            raise BadInputError(f"{what}: refined_camera: {error}") from None
        if covariance.shape != (6 + len(changes), 6 + len(changes)) or not np.isfinite(covariance).all():
            raise BadInputError(f"{what}: joint_covariance of refined_camera must be finite, six rows and one for each change")
        T = se3.as_transform(data.get("T_camera_lidar"), f"T_camera_lidar of refined_camera in {what}")
        return RefinedCamera(camera, T, changes, covariance)


def changed(camera: Camera, name: str, value: float) -> Camera:
    """A camera with one of its intrinsics changed. name: of NAMES. value: in the unit of files."""
    K, D = camera.K.copy(), camera.D.copy()
    if name == FOCAL:
        K[[0, 1], [0, 1]] *= 1 + value
    elif name == ASPECT:
        K[1, 1] *= 1 + value
    elif name == RADIAL:
        D = D if len(D) else np.zeros(COEFFICIENTS[camera.model])
        D[0] += value
    else:
        K[CENTRE.index(name), 2] += value
    return replace(camera, K=K, D=D)


def change_between(given: Camera, camera: Camera, name: str) -> float:
    """By how much `camera` differs from the given one in one of its intrinsics, as `changed` changes it."""
    if name == FOCAL:
        return float(camera.K[0, 0] / given.K[0, 0] - 1)
    if name == ASPECT:
        return float(camera.K[1, 1] / given.K[1, 1] * given.K[0, 0] / camera.K[0, 0] - 1)
    if name == RADIAL:
        return float(np.r_[camera.D, 0.0][0] - np.r_[given.D, 0.0][0])
    axis = CENTRE.index(name)
    return float(camera.K[axis, 2] - given.K[axis, 2])


def camera_info_yaml(camera: Camera, name: str) -> str:
    """A camera of this name as camera_calibration writes it and camera_info_manager reads it. It is monocular: R is the identity,
    and P is K of the rectified image. BadInputError for an unrolled image, which is no lens."""
    if camera.is_sphere:
        raise BadInputError("an unrolled picture has no CameraInfo")
    D = camera.D if len(camera.D) else np.zeros(COEFFICIENTS[camera.model])

    def matrix(values: Matrix) -> dict[str, Any]:
        rows, cols = np.atleast_2d(values).shape
        return {"rows": rows, "cols": cols, "data": [float(v) + 0.0 for v in values.ravel()]}

    entries = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": matrix(camera.K),
        "distortion_model": camera.model,
        "distortion_coefficients": matrix(D),
        "rectification_matrix": matrix(np.eye(3)),
        "projection_matrix": matrix(np.c_[camera.rectified().K, np.zeros(3)]),
    }
    return str(yaml.safe_dump(entries, sort_keys=False, default_flow_style=None, width=1000))

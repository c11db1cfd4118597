"""sensor_msgs/CameraInfo -> Camera."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.errors import BadInputError


def decode_camera_info(msg: Any, rectified: bool = False) -> Camera:
    """sensor_msgs/CameraInfo -> Camera of the image published with it.

    Region of interest and binning are applied as in image_geometry, since K is that of the full image. rectified: the image
    topic is rectified already (image_rect), so that the intrinsics are P[:, :3] without distortion. Raises BadInputError if the
    message is not calibrated or contradicts itself (see Camera).
    """
    K = _numbers(msg, "p" if rectified else "k", 12 if rectified else 9).reshape(3, -1)[:, :3].copy()
    if not K.any():
        matrix = "P" if rectified else "K"
        raise BadInputError(f"CameraInfo: {matrix} is all zero; calibrate the camera's intrinsics and load them in its driver")
    width, height = int(msg.width), int(msg.height)
    roi = getattr(msg, "roi", None)
    if roi is not None and int(roi.width) > 0 and int(roi.height) > 0:
        K[:2, 2] -= (float(roi.x_offset), float(roi.y_offset))
        width, height = int(roi.width), int(roi.height)
    # K belongs to the full resolution; 0 and 1 both mean no binning.
    bin_x, bin_y = (max(int(getattr(msg, name, 0)), 1) for name in ("binning_x", "binning_y"))
    K[0] /= bin_x
    K[1] /= bin_y
    size = (width // bin_x, height // bin_y)
    D = np.asarray(_field(msg, "d"), float)
    if rectified:
        return Camera(K, *size, said_rectified=bool(D.any()))
    return _rectifiable(K.tobytes(), *size, str(msg.distortion_model), D.tobytes())


@lru_cache(maxsize=8)
def _rectifiable(K: bytes, width: int, height: int, model: str, D: bytes) -> Camera:
    """A camera whose images can be rectified. Cached: the same message comes with every image, and a fisheye takes 1 ms."""
    camera = Camera(np.frombuffer(K).reshape(3, 3), width, height, model, np.frombuffer(D))
    try:
        camera.rectified()
    except BadInputError as error:
        raise BadInputError(
            f"CameraInfo: its {camera.model} distortion coefficients do not allow rectification "
            f"({str(error).removeprefix('CameraInfo: ').partition(';')[0]}); calibrate the camera's intrinsics again"
        ) from None
    return camera


def _field(msg: Any, name: str) -> Any:
    """A field that is lower case in ROS 2, and upper case in ROS 1 and in bags converted from it."""
    value = getattr(msg, name, None)
    return getattr(msg, name.upper()) if value is None else value


def _numbers(msg: Any, name: str, count: int) -> NDArray[np.float64]:
    values = np.asarray(_field(msg, name), float).ravel()
    if len(values) != count:
        raise BadInputError(f"CameraInfo: {name.upper()} has {len(values)} numbers, not {count}; check the camera driver")
    return values

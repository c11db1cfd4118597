"""Online, targetless camera-LiDAR extrinsic recalibration."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from calib_ros.result import VERSION as __version__

if TYPE_CHECKING:
    from calib_ros.camera import Camera
    from calib_ros.config import Config
    from calib_ros.datasets import open_dataset, open_source
    from calib_ros.frame import Frame, PointCloud
    from calib_ros.registration.calibrator import Calibrator
    from calib_ros.registration.constraints import SearchBox
    from calib_ros.result import Result

_HOME = {
    "Calibrator": "calib_ros.registration.calibrator",
    "Camera": "calib_ros.camera",
    "Config": "calib_ros.config",
    "Frame": "calib_ros.frame",
    "PointCloud": "calib_ros.frame",
    "Result": "calib_ros.result",
    "SearchBox": "calib_ros.registration.constraints",
    "open_dataset": "calib_ros.datasets.open",
    "open_source": "calib_ros.datasets.open",
}
__all__ = [
    "Calibrator", "Camera", "Config", "Frame", "PointCloud", "Result", "SearchBox", "__version__", "open_dataset", "open_source",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Public names are imported when first used, so that `calib-ros --help` does not wait for OpenCV and SciPy."""
    if name in _HOME:
        import importlib

        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module 'calib_ros' has no attribute '{name}'")

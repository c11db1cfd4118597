"""Online, targetless recalibration of the extrinsic between a camera and a LiDAR.

The public interface of the library::

    from calib_ros import Calibrator, SearchBox, open_dataset

    source = open_dataset("synthetic:seed=1,frames=4")
    frames = [source[i] for i in range(len(source))]
    result = Calibrator(source.camera).calibrate(frames, initial=source.reference, search=SearchBox(5, 0.2))
    print(result.status, result.T_camera_lidar)

Everything else may change between versions.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from calib_ros.version import __version__

if TYPE_CHECKING:
    from calib_ros import se3
    from calib_ros.camera import Camera
    from calib_ros.config import Config
    from calib_ros.datasets import open_dataset, open_source
    from calib_ros.errors import CalibrationError
    from calib_ros.frame import Frame, PointCloud
    from calib_ros.online.recalibrator import Recalibrator
    from calib_ros.registration.calibrator import Calibrator
    from calib_ros.registration.search.constraints import SearchBox
    from calib_ros.result import Result

__all__ = [
    "CalibrationError",
    "Calibrator",
    "Camera",
    "Config",
    "Frame",
    "PointCloud",
    "Recalibrator",
    "Result",
    "SearchBox",
    "__version__",
    "open_dataset",
    "open_source",
    "se3",
]

_MODULES = {
    "CalibrationError": "calib_ros.errors",
    "Calibrator": "calib_ros.registration.calibrator",
    "Camera": "calib_ros.camera",
    "Config": "calib_ros.config",
    "Frame": "calib_ros.frame",
    "PointCloud": "calib_ros.frame",
    "Recalibrator": "calib_ros.online.recalibrator",
    "Result": "calib_ros.result",
    "SearchBox": "calib_ros.registration.search.constraints",
    "open_dataset": "calib_ros.datasets",
    "open_source": "calib_ros.datasets",
    "se3": "calib_ros.se3",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that `import calib_ros` and `calib-ros --help` do not load OpenCV and SciPy."""
    if name in _MODULES:
        module = import_module(_MODULES[name])
        return getattr(module, name, module)  # se3 is a module itself
    raise AttributeError(f"module 'calib_ros' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)

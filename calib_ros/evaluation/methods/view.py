"""A frame as every compared method gets it: a rectified picture, and points where they stand at its moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib_ros.camera import Camera
from calib_ros.config import Config
from calib_ros.frame import Frame, PointCloud
from calib_ros.image.enhance import to_gray
from calib_ros.lidar.deskew import still_cloud
from calib_ros.lidar.scan import reflectivity, require_returns
from calib_ros.registration.features import FeatureExtractor


@dataclass(frozen=True, eq=False)
class View:
    """gray: (h, w) uint8. camera: its pinhole. measured: the scan as it was measured, finite points only, in the source's order;
    neighbours are to be looked for in it. xyz: (n, 3) float32 m where these points stand at the image's moment, LiDAR frame.
    reflectivity: (n,) float32 in 0..1, None if the source has none.
    """

    gray: NDArray[np.uint8]
    camera: Camera
    measured: PointCloud
    xyz: NDArray[np.float32]
    reflectivity: NDArray[np.float32] | None


class Viewer:
    """Makes views; the look-up tables of the last camera's lens are kept."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self._extract: FeatureExtractor | None = None

    def __call__(self, frame: Frame) -> View:
        """View of a frame. TooFewFeaturesError if hardly anything returned, BadTimesError for times that cannot be."""
        require_returns(frame.cloud)
        if self._extract is None or self._extract.source_camera != frame.camera:
            self._extract = FeatureExtractor(frame.camera, self.config)
        extract, cloud, keep = self._extract, frame.cloud, frame.cloud.finite_mask()
        at_image = still_cloud(frame, self.config.motion)
        measured = cloud.finite()
        xyz = measured.xyz if at_image is None else at_image[keep]
        return View(to_gray(extract.working_image(frame.image)), extract.camera, measured, xyz, reflectivity(measured.intensity))

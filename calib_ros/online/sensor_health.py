"""Do the sensors see anything? A covered lens, a frozen image and an empty scan are no scenes to calibrate on."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import MonitorConfig
from calib_ros.frame import Frame, PointCloud

SHRUNK = 8  # px that make one: noise of a dark image averages out, houses and cars stay
REMEMBERED = 100  # frames that tell what is usual
LEARNED = 5  # frames before anything is called unusual
ACCUSTOMED = 300  # frames of little in a row, half a minute, after which this is what is usual: a garage, an open field
NO_CONTRAST = 1.0  # grey levels between neighbouring squares; streets by day and night have 4 to 20
COMPARED = 500  # points that tell whether two scans are the same


class SensorHealth:
    """Looks at every frame, which costs a millisecond. Not for several threads at once. config may be replaced at any time."""

    def __init__(self, config: MonitorConfig) -> None:
        self.config = config
        self._contrast: deque[float] = deque(maxlen=REMEMBERED)
        self._returns: deque[int] = deque(maxlen=REMEMBERED)
        self._image: NDArray[np.uint8] | None = None
        self._cloud: NDArray[np.float32] | None = None
        self._same = self._dull = self._thin = 0

    def check(self, frame: Frame) -> str:
        """What is wrong with the frame's image or scan, in words for a person; empty if nothing is."""
        problem = self._camera(frame) or self._scanner(frame.cloud)
        return problem

    def _camera(self, frame: Frame) -> str:
        small = _shrunk(frame.image)
        contrast = float(np.mean([np.abs(np.diff(small.astype(np.int16), axis=axis)).mean() for axis in (0, 1)]))
        frozen = self._frozen(frame)
        usual = float(np.median(self._contrast)) if len(self._contrast) >= LEARNED else 0.0
        self._dull = self._dull + 1 if NO_CONTRAST <= contrast < self.config.blind_contrast * usual else 0
        if self._dull > ACCUSTOMED:
            self._contrast.clear()
        elif contrast < NO_CONTRAST or self._dull:
            seen = f"contrast {contrast:.1f}" + (f", usually {usual:.1f}" if usual else "")
            return f"the camera shows nothing ({seen}): a covered lens, no light, or overexposed"
        self._contrast.append(contrast)
        if frozen:
            return f"the image has not changed for {self._same} frames while the scans do: restart the camera driver"
        return ""

    def _frozen(self, frame: Frame) -> bool:
        points = frame.cloud.xyz[:: max(len(frame.cloud) // COMPARED, 1)]
        # Every pixel: shrunk, the noise of a vehicle at rest may be gone.
        same_image = self._image is not None and np.array_equal(frame.image, self._image)
        same_cloud = self._cloud is not None and np.array_equal(points, self._cloud, equal_nan=True)
        self._image, self._cloud = frame.image, points.copy()
        if not same_image:
            self._same = 0
        elif not same_cloud:  # a simulation at rest repeats both
            self._same += 1
        return 0 < self.config.frozen_images <= self._same

    def _scanner(self, cloud: PointCloud) -> str:
        returns = int(cloud.finite_mask().sum())
        usual = float(np.median(self._returns)) if len(self._returns) >= LEARNED else 0.0
        self._thin = self._thin + 1 if 0 < returns < self.config.blind_returns * usual else 0
        if self._thin > ACCUSTOMED:
            self._returns.clear()
        elif returns == 0 or self._thin:
            return f"the LiDAR shows nothing ({returns} returns, usually {usual:.0f}): a covered or failing scanner"
        self._returns.append(returns)
        return ""


def _shrunk(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey, a SHRUNKth of the size."""
    grey = image if image.ndim == 2 else image[:, :, 1]
    size = (max(grey.shape[1] // SHRUNK, 2), max(grey.shape[0] // SHRUNK, 2))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)

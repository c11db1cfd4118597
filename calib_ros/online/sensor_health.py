"""Do the sensors work? A covered lens, a frozen image and an empty scan are no scenes to calibrate on."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.frame import Frame
from calib_ros.result import Trouble

SHRINK_FACTOR = 8  # px that make one: noise of a dark image averages out, houses and cars stay
HISTORY = 100  # frames whose median is the usual value
MIN_HISTORY = 5  # frames before any value is called unusual
ACCUSTOMED = 300  # frames of little in a row, half a minute, after which this is what is usual: a garage, an open field
# Shares of the usual contrast and number of returns below which a sensor is blinded: far below what scenes differ by.
BLIND_CONTRAST, BLIND_RETURNS = 0.25, 0.2
LEAST = 1.0  # return, and grey level between neighbouring squares: streets by day and night have 4 to 20
COMPARED_POINTS = 500  # points that decide whether two scans are the same
FROZEN_IMAGES = 5  # identical ones in a row while the scans change: a driver that repeats one now and then is none
SOME_ROWS = 16  # one row in so many tells most images apart


class SensorFault(Trouble):
    """What is wrong with a sensor."""

    CAMERA_BLIND = "camera blind", "the camera shows nothing", "clean or uncover the camera, or give it light"
    IMAGE_FROZEN = "image frozen", "the image stands still while scans change", "restart the camera or its driver"
    LIDAR_BLIND = "lidar blind", "the LiDAR shows nothing", "clean or uncover the LiDAR, or check its driver"


@dataclass(frozen=True)
class SensorProblem:
    """A fault, and a message for a person. Two problems are equal whatever figures their messages give."""

    fault: SensorFault
    message: str = field(compare=False)

    @classmethod
    def of(cls, fault: SensorFault, figures: str) -> SensorProblem:
        """With the usual message."""
        return cls(fault, f"{fault.words} ({figures}): {fault.advice}")


class SensorHealth:
    """Checks every frame, which takes a millisecond. Not thread-safe.

    faulty_frames: the newest ones, in a row.
    """

    def __init__(self) -> None:
        self._usual: dict[SensorFault, deque[float]] = defaultdict(lambda: deque(maxlen=HISTORY))
        self._low: dict[SensorFault, int] = defaultdict(int)  # frames in a row
        self._image: NDArray[np.uint8] | None = None
        self._points: NDArray[np.float32] | None = None
        self.faulty_frames = self._repeated_images = 0  # in a row

    def check(self, frame: Frame) -> SensorProblem | None:
        """The problem of the frame's image or scan, None if there is none. The camera comes first."""
        if (problem := self._check_camera(frame)) is None:
            returns, said = int(frame.cloud.finite_mask().sum()), "{} returns, usually {{:.0f}}"
            problem = self._blind(SensorFault.LIDAR_BLIND, returns, BLIND_RETURNS, said.format(returns or "no"))
        self.faulty_frames = self.faulty_frames + 1 if problem else 0
        return problem

    def _check_camera(self, frame: Frame) -> SensorProblem | None:
        # Grey, at 1 / SHRINK_FACTOR of the size; without what is left over of it, since whole factors are quicker.
        grey = frame.image if frame.image.ndim == 2 else cv2.extractChannel(frame.image, 1)
        height, width = (max(size // SHRINK_FACTOR, 2) for size in grey.shape)
        whole = grey[: height * SHRINK_FACTOR, : width * SHRINK_FACTOR]
        small = np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        contrast = float(np.mean([np.abs(np.diff(small.astype(np.int16), axis=axis)).mean() for axis in (0, 1)]))
        said = f"contrast {contrast:.1f}, usually {{:.1f}}"
        frozen, blind = self._is_frozen(frame), self._blind(SensorFault.CAMERA_BLIND, contrast, BLIND_CONTRAST, said)
        return blind or (SensorProblem.of(SensorFault.IMAGE_FROZEN, f"{self._repeated_images} frames") if frozen else None)

    def _is_frozen(self, frame: Frame) -> bool:
        points = frame.cloud.xyz[:: max(len(frame.cloud) // COMPARED_POINTS, 1)]
        # Every pixel: shrunk, the noise of a vehicle at rest may be gone.
        last, some = self._image, np.s_[::SOME_ROWS]
        same_image = last is not None and np.array_equal(frame.image[some], last[some]) and np.array_equal(frame.image, last)
        same_cloud = self._points is not None and np.array_equal(points, self._points, equal_nan=True)
        self._image, self._points = frame.image, points.copy()
        if not same_image:
            self._repeated_images = 0
        elif not same_cloud:  # a simulation at rest repeats both
            self._repeated_images += 1
        return self._repeated_images >= FROZEN_IMAGES

    def _blind(self, fault: SensorFault, value: float, share: float, said: str) -> SensorProblem | None:
        """The problem of a value that is none, or less than this share of what is usual; what stays becomes usual."""
        usual = float(np.median(self._usual[fault])) if len(self._usual[fault]) >= MIN_HISTORY else 0.0
        self._low[fault] = self._low[fault] + 1 if LEAST <= value < share * usual else 0
        if self._low[fault] > ACCUSTOMED:
            self._usual[fault].clear()
        elif value < LEAST or self._low[fault]:
            return SensorProblem.of(fault, said.format(usual) if usual else said.partition(",")[0])
        self._usual[fault].append(value)
        return None

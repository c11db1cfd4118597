"""Which frames are worth keeping: scene selection by histogram similarity (thesis 3.6, eq. 3.15, algorithm 6)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from calib_ros.config import OnlineConfig
from calib_ros.frame import NANOSECONDS

Histogram = NDArray[np.float32]


def histogram(image: NDArray[np.uint8]) -> Histogram:
    """Image (H, W) or (H, W, 3) uint8 -> share of pixels per brightness and channel, (channels, 256) float32.

    Every second pixel of every second row is counted: the shares do not change, the time does.
    """
    part = np.ascontiguousarray(image[::2, ::2])
    channels = 1 if part.ndim == 2 else part.shape[2]
    counts = [cv2.calcHist([part], [k], None, [256], [0, 256]).ravel() for k in range(channels)]
    return np.asarray(np.stack(counts) / (part.shape[0] * part.shape[1]), np.float32)


def similarity(first: Histogram, second: Histogram) -> float:
    """Intersection over union of two histograms, eq. 3.15, averaged over the channels.

    The thesis sums the channels and says the ratio lies in 0..1; only their mean does. A grey and a colour image (different
    numbers of channels) are entirely different: 0.
    """
    if first.shape != second.shape:
        return 0.0
    common = np.minimum(first, second).sum(axis=1)
    union = first.sum(axis=1) + second.sum(axis=1) - common
    return float(np.mean(common / np.maximum(union, 1e-12)))


class KeyframeSelector:
    """Algorithm 6, one image at a time, with a spread over time where too few images differ enough."""

    def __init__(self, config: OnlineConfig) -> None:
        self.config = config
        self.last_similarity = 0.0
        self._histogram: Histogram | None = None
        self._stamp = 0

    def reset(self) -> None:
        """The next image starts a new series."""
        self._histogram = None

    def offer(self, image: NDArray[np.uint8], stamp: int) -> bool:
        """True if the image (stamp in ns) is a keyframe; it is then what the next ones are compared with."""
        return self.offer_histogram(histogram(image), stamp)

    def offer_histogram(self, new: Histogram, stamp: int) -> bool:
        """The same of an image's histogram."""
        last = self._histogram  # reset() may come from another thread
        if last is not None:
            self.last_similarity = similarity(last, new)
            elapsed = (stamp - self._stamp) / NANOSECONDS
            if 0 <= elapsed < self.config.keyframe_spacing_s:
                return False
            overdue = elapsed >= self.config.keyframe_interval_s or elapsed < 0  # the clock was set back
            changed = self.last_similarity < self.config.static_similarity
            if not (changed and (overdue or self.last_similarity < self.config.similarity_threshold)):
                return False
        self._histogram, self._stamp = new, stamp
        return True

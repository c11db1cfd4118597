"""Sources made of others."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from calib_ros.config import MotionConfig
from calib_ros.datasets import open_dataset
from calib_ros.datasets.source import Source, WithMotion
from calib_ros.frame import Frame


def frames_of(name: str, motion: MotionConfig | None = None) -> list[Frame]:
    """All frames of a source by its name; with the vehicle's motion from neighbouring scans, if that is wanted."""
    source: Source = open_dataset(name)
    source = source if motion is None else WithMotion(source, motion)
    return [source[k] for k in range(len(source))]


class Changed:
    """Another source with its frames changed, as they are asked for; itself a Source. camera, reference: those of the source."""

    def __init__(self, source: Source, change: Callable[[Frame], Frame] = lambda frame: frame) -> None:
        self.source, self._change = source, change
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Frame:
        return self._change(self.source[index])

    def describe(self) -> dict[str, str]:
        """As the source."""
        return self.source.describe()


class Listed:
    """Frames in memory as a source."""

    camera_frame, lidar_frame = "camera", "lidar"

    def __init__(self, name: str, frames: Sequence[Frame]) -> None:
        self.name, self._frames, self.camera, self.reference = name, frames, frames[0].camera, frames[0].reference

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> Frame:
        return self._frames[index]

    def describe(self) -> dict[str, str]:
        return {}

"""`calib-ros convert`."""

from __future__ import annotations

from calib_ros.commands.terminal import progress_bar
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.source import Source
from calib_ros.frame import Frame
from calib_ros.sources import frame_positions


class Selection:
    """Some frames of a source, in the order asked for; a Source itself."""

    def __init__(self, source: Source, positions: list[int]) -> None:
        self._source, self._positions = source, positions
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame

    def __len__(self) -> int:
        return len(self._positions)

    def __getitem__(self, index: int) -> Frame:
        return self._source[self._positions[index]]

    def describe(self) -> dict[str, str]:
        """As the source, with the number of frames chosen."""
        return {**self._source.describe(), "frames": str(len(self))}


def convert(source: Source, bag: str, frames: str, storage: str) -> str:
    """Write frames of a source as a bag; returns a line for the user."""
    selection = Selection(source, frame_positions(frames, len(source)))
    with progress_bar("writing") as step:
        path = write_bag(selection, bag, storage, progress=step)
    return f"{len(selection)} frames written to {path}; play them with: calib-ros play {path}"

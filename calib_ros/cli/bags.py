"""`calib-ros convert` and `calib-ros export`."""

from __future__ import annotations

from calib_ros import export
from calib_ros.cli.output import note, progress_bar
from calib_ros.datasets.bag_writer import write_bag
from calib_ros.datasets.positions import frame_positions
from calib_ros.datasets.source import Source
from calib_ros.frame import Frame
from calib_ros.io import write_atomically
from calib_ros.online.state import read_state


class Selection:
    """Some frames of a source in a given order; itself a Source."""

    def __init__(self, source: Source, positions: list[int]) -> None:
        self._source, self._positions = source, positions
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame

    def __len__(self) -> int:
        return len(self._positions)

    def __getitem__(self, index: int) -> Frame:
        return self._source[self._positions[index]]

    def describe(self) -> dict[str, str]:
        """As the source, with the number of selected frames."""
        return {**self._source.describe(), "frames": str(len(self))}


def convert(source: Source, bag: str, frames: str, storage: str) -> str:
    """Write frames of a source as a bag; returns a line for the user."""
    selection = Selection(source, frame_positions(frames, len(source)))
    with progress_bar("writing") as step:
        path = write_bag(selection, bag, storage, progress=step)
    return f"{len(selection)} frames written to {path}; play them with: calib-ros play {path}"


def export_result(file: str, form: str, parent: str, camera_frame: str | None, lidar_frame: str | None, out: str | None) -> str:
    """A result or state file as text in another format; with `out` it is written there, and a line for the user is returned.

    An extrinsic that is not an accepted estimate is exported with a note, since initial ones are exported as well.
    """
    state = read_state(file)
    result = state.result
    text = export.export(result, form, parent, state.camera, camera_frame, lidar_frame)
    if not result.converged:
        why = f" ({' '.join(result.reason.split())})" if result.reason else ""
        note(f"calib-ros: {file} is not an accepted estimate, its status is {result.status}{why}; exported all the same")
    if form == "kitti" and state.camera is not None and not state.camera.is_pinhole:
        note("calib-ros: no P0 written, the camera has distortion; Tr holds for its rectified image, too")
    if out is None or out == "-":
        return text
    write_atomically(out, text.encode())
    return f"wrote {out}\n"

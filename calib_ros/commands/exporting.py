"""`calib-ros export`."""

from __future__ import annotations

from calib_ros import exports
from calib_ros.commands.terminal import note
from calib_ros.files import write_atomically
from calib_ros.online.state import read_state


def export(file: str, form: str, parent: str, camera_frame: str | None, lidar_frame: str | None, out: str | None) -> str:
    """A result or state file in another format, to be printed; with `out` it is written there and a line for the user comes back.

    An extrinsic that no estimate stands behind is exported, too, since initial ones have to be written as well: with a note.
    """
    state = read_state(file)
    result = state.result
    text = exports.export(result, form, parent, state.camera, camera_frame, lidar_frame)
    if not result.converged:
        why = f" ({' '.join(result.reason.split())})" if result.reason else ""
        note(f"calib-ros: {file} is not an accepted estimate, its status is {result.status}{why}; exported all the same")
    if form == "kitti" and state.camera is not None and not state.camera.is_pinhole:
        note("calib-ros: no P0 written, the camera has distortion; Tr holds for its rectified image, too")
    if out is None or out == "-":
        return text
    write_atomically(out, text.encode())
    return f"wrote {out}\n"

"""A drive of one pair, as a source of its own."""

from __future__ import annotations

from typing import Any

from calib_ros_synthetic.parameters import parsed
from calib_ros_synthetic.rig import RigPair, SyntheticRig


class SyntheticDrive(RigPair):
    """Frames of a drive, with the exact extrinsic as reference.

    Parameters
    ----------
    seed : of the scene. frames : their number.
    rings : 16, 32, 64 (default) or 128 of a spinning LiDAR; 0 for a scanner without rings, which scans a never-repeating rosette
        ahead. A rig has its own scanner.
    width, height : px, by default 1242x375 or the rig's, of which one alone keeps the shape; not used with `camera`.
    speed : m/s; at 0 the vehicle stops for every frame, where it would be at its usual speed. By default what is usual in the
        scene (5 m/s in the street), as far as the rig's vehicle can go.
    stride : tenths of a second from one frame to the next; at 10 Hz, scans.
    noise : factor on all sensor noise; 0 = none.
    T_camera_lidar : extrinsic (4, 4); by default a camera below and in front of the LiDAR, or where the rig has it, rotated by
        tilt_deg degrees about an axis that depends on the seed. camera : Camera instead of the rig's.
    rig : a name in rigs.RIGS. scene : a name in scenes.SCENES. condition : a name in camera.CONDITIONS, by default the rig's.
    fields : all, xyzir, xyzi or xyz: what the clouds hold, by default what the rig's driver gives.
    ride : steady, or weaving: the vehicle swerves, brakes and accelerates.
    image_late_ms : images are stamped that much late; jitter_ms : standard deviation of their stamps.
    stamp_at : start, middle or end, the part of the scan that its stamp refers to; middle is where the scanner faces ahead.
    spin : clockwise or counterclockwise, seen from above.

    Raises BadInputError for values out of range and for unknown names.
    """

    def __init__(
        self, seed: int = 0, frames: int = 20, rings: int | None = None, *, rig: str | None = None, **options: Any
    ) -> None:
        given: dict[str, Any] = {"rings": rings} if rings is not None else {}
        of = SyntheticRig(rig, seed=seed, frames=frames, **given, **options)
        super().__init__(of, of.cameras[0], of.lidars[0])

    @classmethod
    def from_text(cls, text: str) -> SyntheticDrive:
        """`synthetic`, `synthetic:seed=3,frames=16,rings=32` or `synthetic:rig=os1_128_windshield,scene=park`: any parameters
        that are numbers or names."""
        return cls(**parsed(text))

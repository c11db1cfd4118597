"""An extrinsic in the formats of other tools.

T_camera_lidar maps LiDAR points into the camera's optical frame. In ROS that is the pose of the LiDAR in its parent, the camera:
frame_id = camera, child_frame_id = LiDAR, the same numbers. With the LiDAR as parent the transform is inverted. Lengths are in
metres, angles in radians; roll, pitch, yaw turn about the parent's fixed axes x, y, z in this order:
R = Rz(yaw) Ry(pitch) Rx(roll).
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from xml.sax.saxutils import quoteattr

import numpy as np
import yaml

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.errors import BadInputError
from calib_ros.result import Result


@dataclass(frozen=True, eq=False)
class Pose:
    """The pose of `child` in `parent`: T (4, 4) maps points of the child into the parent."""

    parent: str
    child: str
    T: Transform

    @staticmethod
    def of(result: Result, parent: str = "camera") -> Pose:
        """parent: camera or lidar. BadInputError for another one, or if the frames have no or the same name."""
        camera, lidar = result.camera_frame, result.lidar_frame
        if not camera.strip() or not lidar.strip():
            raise BadInputError("a frame has no name; give --camera-frame and --lidar-frame")
        if camera == lidar:
            raise BadInputError(f"camera and LiDAR frame are both '{camera}'; give --camera-frame or --lidar-frame")
        if parent not in ("camera", "lidar"):
            raise BadInputError(f"parent '{parent}' is not known; choose camera or lidar")
        T = result.T_camera_lidar
        return Pose(camera, lidar, T) if parent == "camera" else Pose(lidar, camera, se3.inverse(T))

    @property
    def xyz(self) -> tuple[float, float, float]:
        """Metres."""
        x, y, z = (float(v) + 0.0 for v in self.T[:3, 3])  # + 0: no "-0.0" in files that people read
        return x, y, z

    @property
    def rpy(self) -> tuple[float, float, float]:
        """Roll, pitch, yaw in rad; pitch within +-90 deg."""
        # Yaw is taken off before roll is read: near gimbal lock, where optical frames are, both would be noise otherwise.
        R = self.T[:3, :3]
        yaw = math.atan2(R[1, 0], R[0, 0])
        s, c = math.sin(yaw), math.cos(yaw)
        pitch = math.atan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
        roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
        return roll + 0.0, pitch + 0.0, yaw + 0.0


def tf_command(pose: Pose) -> str:
    """The command that publishes the pose on /tf_static."""
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    values = [*pose.xyz, *(float(v) + 0.0 for v in se3.quaternion_from_rotation(pose.T[:3, :3]))]
    numbers = " ".join(f"{name} {_number(value)}" for name, value in zip(names, values, strict=True))
    frames = f"--frame-id {shlex.quote(pose.parent)} --child-frame-id {shlex.quote(pose.child)}"
    return f"ros2 run tf2_ros static_transform_publisher {numbers} {frames}\n"


def urdf_joint(pose: Pose) -> str:
    """A fixed joint between two links that the robot's description holds already."""
    return (
        f'<joint name={quoteattr(f"{pose.parent}_to_{pose.child}")} type="fixed">\n'
        f"  <parent link={quoteattr(pose.parent)}/>\n"
        f"  <child link={quoteattr(pose.child)}/>\n"
        f'  <origin xyz="{_numbers(pose.xyz)}" rpy="{_numbers(pose.rpy)}"/>\n'
        "</joint>\n"
    )


def autoware_yaml(pose: Pose) -> str:
    """An entry of Autoware's sensors_calibration.yaml or sensor_kit_calibration.yaml."""
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    entry = dict(zip(names, (*pose.xyz, *pose.rpy), strict=True))
    return str(yaml.safe_dump({pose.parent: {pose.child: entry}}, sort_keys=False))


def kitti_odometry(result: Result, camera: Camera | None = None) -> str:
    """Lines of calib.txt as in KITTI odometry: `Tr`, LiDAR to rectified camera 0, and P0 = K [I | 0] of a camera without
    distortion, which is taken as camera 0."""
    Tr = f"Tr: {_numbers(result.T_camera_lidar[:3].ravel())}\n"
    if camera is None or not camera.is_pinhole:
        return Tr
    return f"P0: {_numbers(np.c_[camera.K, np.zeros(3)].ravel())}\n{Tr}"


def kitti_raw(result: Result) -> str:
    """calib_velo_to_cam.txt as in KITTI raw: `R` and `T`, LiDAR to a camera 0 with R_rect_00 = I and P_rect_00 = K [I | 0].
    Beside KITTI's own calib_cam_to_cam.txt, of another R_rect_00, these lines are wrong."""
    T = result.T_camera_lidar
    return f"R: {_numbers(T[:3, :3].ravel())}\nT: {_numbers(T[:3, 3])}\n"


_OF_POSE: dict[str, Callable[[Pose], str]] = {"tf": tf_command, "urdf": urdf_joint, "autoware": autoware_yaml}
_OF_RESULT: dict[str, Callable[[Result, Camera | None], str]] = {
    "kitti": kitti_odometry,
    "kitti-raw": lambda result, _: kitti_raw(result),
    "json": lambda result, _: result.dumps(),
    "yaml": lambda result, _: result.dumps(yaml_format=True),
}
FORMATS = (*_OF_POSE, *_OF_RESULT)


def export(
    result: Result,
    form: str,
    parent: str = "camera",
    camera: Camera | None = None,
    camera_frame: str | None = None,
    lidar_frame: str | None = None,
) -> str:
    """Text of a result in one of FORMATS, ending in a newline; frames may be renamed.

    parent: camera or lidar. camera: intrinsics if known, for P0 of kitti. BadInputError if the format is unknown or cannot have
    the LiDAR as parent, or if the frames' names will not do.
    """
    if form not in FORMATS:
        raise BadInputError(f"format '{form}' is not known; choose one of {', '.join(FORMATS)}")
    result = replace(
        result,
        camera_frame=result.camera_frame if camera_frame is None else camera_frame,
        lidar_frame=result.lidar_frame if lidar_frame is None else lidar_frame,
    )
    if form in _OF_POSE:
        return _OF_POSE[form](Pose.of(result, parent))
    if parent != "camera":
        raise BadInputError(f"{form} files hold the transform from LiDAR to camera by definition; leave out --parent {parent}")
    return _OF_RESULT[form](result, camera)


def _number(value: float) -> str:
    return repr(float(value))  # the shortest text that gives back every bit


def _numbers(values: object) -> str:
    return " ".join(_number(value + 0.0) for value in np.asarray(values, float))

"""KITTI folders as sequences of frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from calib_ros.camera import Camera
from calib_ros.datasets.kitti_files import IMAGE_SUFFIXES, numbered_files, read_picture, read_scan
from calib_ros.datasets.kitti_layouts import LOOKED_FOR, find_drive, layout_of
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame

# As kitti2bag named them.
CAMERA_FRAMES = ("camera_gray_left", "camera_gray_right", "camera_color_left", "camera_color_right")
LIDAR_FRAME = "velo_link"


class KittiSource:
    """Frames of a KITTI raw drive, odometry sequence or object folder, for one of the cameras 0 to 3.

    A frame is a number with a picture and a scan; its stamps belong to that number, so that missing frames
    leave gaps. Raw drives tell when each point was measured, their stamp is the moment that the image shows,
    and with oxts they tell how fast the LiDAR moved. Pictures and scans are read when a frame is asked for. In
    the object layout each frame has its own calibration: `camera` and `reference` are then those of the first
    frame, and Frame.camera and Frame.reference the frame's own. BadInputError, with the path and what to do: no
    KITTI folder, a camera that is not there, missing or damaged files.
    """

    def __init__(self, path: str | Path, camera: int = 2) -> None:
        root = find_drive(Path(path))
        if root is None:
            raise BadInputError(f"{path} is no KITTI folder; looked for {LOOKED_FOR}")
        self._layout = layout_of(root, camera)
        self.path = root
        self.name = root.resolve().name
        self.camera_frame = CAMERA_FRAMES[camera]
        self.lidar_frame = LIDAR_FRAME
        self._camera_number = camera
        self._images = numbered_files(self._layout.images[camera], IMAGE_SUFFIXES)
        self._scans = numbered_files(self._layout.scans, (".bin",))
        self.numbers = sorted(self._images.keys() & self._scans.keys())
        if not self.numbers:
            pictures, scans = (self._layout.images[camera].relative_to(root), self._layout.scans.relative_to(root))
            raise BadInputError(
                f"{root}: no number has both a picture ({len(self._images)} in {pictures}) and a scan "
                f"({len(self._scans)} in {scans}); download both of this drive"
            )
        first = self.numbers[0]
        P, self.reference = self._layout.calibrate(first)
        height, width = read_picture(self._images[first]).shape[:2]
        self.camera = Camera(P[:, :3], width, height)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> Frame:
        number = self.numbers[index]
        image = read_picture(self._images[number])
        P, T_camera_lidar = self._layout.calibrate(number)
        stamp, cloud_stamp = self._layout.stamps(number)
        height, width = image.shape[:2]
        cloud, motion = read_scan(self._scans[number]), self._layout.motion
        if motion is not None:
            cloud = replace(cloud, time=motion.times(cloud, number))
        return Frame(
            image=image,
            cloud=cloud,
            camera=Camera(P[:, :3], width, height),
            stamp=stamp,
            cloud_stamp=cloud_stamp,
            reference=T_camera_lidar,
            name=self._scans[number].stem,
            twist=None if motion is None else motion.twist(number),
            compensated=self._layout.compensated,
        )

    def describe(self) -> dict[str, str]:
        """What the folder holds: label -> text."""
        frames, images, scans = len(self), len(self._images), len(self._scans)
        return {
            "kind": f"KITTI {self._layout.kind}",
            "path": str(self.path),
            "frames": f"{frames}, numbers {self.numbers[0]} to {self.numbers[-1]}; left out: "
            f"{images - frames} pictures without scan, {scans - frames} scans without picture",
            "stamps": self._layout.stamps_from,
            "motion": self._layout.motion_from,
            "cameras": ", ".join(
                f"{number}{' (chosen)' if number == self._camera_number else ''}" for number in self._layout.images
            ),
            "camera": describe_camera(self.camera) + (" (of the first frame)" if self._layout.kind == "object" else ""),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "from the calibration files" + (", one per frame" if self._layout.kind == "object" else ""),
        }

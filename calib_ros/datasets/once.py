"""Scenes of ONCE (Mao et al., One Million Scenes for Autonomous Driving, 2021) as sequences of frames."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.kitti_files import numbered_files, read_image, read_scan
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame
from calib_ros.messages.camera_info import decode_camera_info
from calib_ros.messages.wire import shown

SCANS = "lidar_roof"
EXPECTED_ONCE = f"{SCANS}, cam0N and NAME.json (a scene of ONCE)"
MILLISECOND_NS, STAMP_DIGITS = 1_000_000, 13  # files are named by their time
PLUMB_BOB = 5  # numbers of that distortion, at most


class OnceSource:
    """Frames of a scene of ONCE, for one of its cameras, by default the first: a time with a picture and a scan.

    Raises BadInputError, with the path and what to do, for an unknown camera, missing or damaged files.
    """

    lidar_frame = SCANS

    def __init__(self, path: str | Path, camera: int | str | None = None) -> None:
        self.path = Path(path)
        self.name = self.path.resolve().name
        file = self.path / f"{self.name}.json"
        try:
            cameras = dict(json.loads(file.read_bytes())["calib"])
        except OSError as error:
            raise BadInputError(f"{file} cannot be read ({error.strerror}); download the scene's annotations") from None
        except (ValueError, TypeError, KeyError, RecursionError):
            raise BadInputError(f"{file} has no cameras under 'calib'; download the scene's annotations again") from None
        names = sorted(map(str, cameras))
        self.camera_frame = dict(enumerate(names)).get(camera or 0, "") if not isinstance(camera, str) else camera
        if self.camera_frame not in cameras:
            raise BadInputError(f"{self.path} has no camera {camera or 0}; it has {', '.join(map(shown, names)) or 'none'}")
        self.cameras = [name for name in names if (self.path / name).is_dir()]
        self._others = [name for name in names if name != self.camera_frame]
        self._images = numbered_files(self.path / self.camera_frame, (".jpg", ".png"), STAMP_DIGITS)
        self._scans = numbered_files(self.path / SCANS, (".bin",), STAMP_DIGITS)
        self.numbers = sorted(self._images.keys() & self._scans.keys())
        if not self.numbers:
            raise BadInputError(
                f"{self.path}: no time has both a picture ({len(self._images)} in {self.camera_frame}) and a scan "
                f"({len(self._scans)} in {SCANS}); download both of this scene"
            )
        height, width = read_image(self._images[self.numbers[0]]).shape[:2]
        try:
            self.camera, self.reference = _calibration(cameras[self.camera_frame], width, height)
        except BadInputError as error:
            raise BadInputError(f"{file}, {self.camera_frame}: {str(error).removeprefix('CameraInfo: ')}") from error
        except (KeyError, TypeError, ValueError) as error:
            raise BadInputError(f"{file}, {self.camera_frame}: incomplete ({shown(error)}); download it again") from None

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> Frame:
        number = self.numbers[index]
        stamp = number * MILLISECOND_NS
        cloud, image = read_scan(self._scans[number]), read_image(self._images[number])
        return Frame(
            image=image, cloud=cloud, camera=self.camera, stamp=stamp, reference=self.reference, name=self._scans[number].stem
        )

    def describe(self) -> dict[str, str]:
        """What the scene holds: label -> text."""
        return {
            "kind": "ONCE",
            "path": str(self.path),
            "frames": f"{len(self)}; left out: {len(self._images) - len(self)} pictures without scan, "
            f"{len(self._scans) - len(self)} scans without picture",
            "stamps": "names of files",
            "camera": describe_camera(self.camera) + "".join(f"; not {name}" for name in self._others),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "from the scene's file",
        }


def _calibration(own: Any, width: int, height: int) -> tuple[Camera, Transform]:
    """Camera and T_camera_lidar (4, 4) of what the file says of a camera."""
    D, K = (np.ravel(np.asarray(own[name], float)) for name in ("distortion", "cam_intrinsic"))
    model = "plumb_bob" if len(D) <= PLUMB_BOB else "rational_polynomial"  # as OpenCV takes them
    camera = decode_camera_info(SimpleNamespace(width=width, height=height, k=K, d=D, distortion_model=model))
    return camera, se3.inverse(se3.as_transform(own["cam_to_velo"], "cam_to_velo"))


def is_once(path: Path) -> bool:
    """Whether a path is a scene, complete or not."""
    return (path / SCANS).is_dir() and not (path / "images").is_dir()

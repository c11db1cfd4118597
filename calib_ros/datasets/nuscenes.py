"""Scenes of nuScenes as sequences of frames, from its JSON tables alone (schema: nuscenes-devkit, docs/schema_nuscenes.md)."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from calib_ros import se3
from calib_ros.arrays import Matrix, Transform
from calib_ros.camera import Camera
from calib_ros.datasets.kitti_files import read_image, read_points
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.messages.wire import shown

Row = dict[str, Any]
T = TypeVar("T")
EXPECTED_NUSCENES = "v1.0-*/sample_data.json and samples/ (nuScenes)"
CAMERA, LIDAR = "CAM_FRONT", "LIDAR_TOP"
STAMP_NS = 1000  # stamps of the tables are in microseconds
MAX_GAP_NS = 300_000_000  # between two poses whose difference is a velocity; scans are 50 ms apart
SHOWN_SCENES = 10  # all of v1.0-mini


class Record(NamedTuple):
    """A row of sample_data: tokens of its sample and ego pose; channel, T_ego_sensor (4, 4) and camera matrix (3, 3) of its
    sensor, empty for others than cameras; path below the root, stamp in ns, size in px of images."""

    sample: str
    pose: str
    channel: str
    T_ego_sensor: Transform
    K: Matrix
    filename: str
    stamp: int
    key: bool
    size: tuple[int, int]


class NuScenesSource:
    """The key frames of a nuScenes scene, for one of its cameras: about 40, half a second apart.

    The scans are motion-compensated to their stamp; the LiDAR's twist, from the ego poses of the scans before and after, takes
    them from there to the image's. The reference is T_camera_lidar = inv(T_ego_camera) T_ego_lidar of calibrated_sensor.

    Parameters
    ----------
    path : the dataset's root, or one of its v1.0-* folders; ``PATH#scene-0061`` chooses a scene, by default the first.
    camera : channel, like "CAM_BACK", or its position in the list that `describe` shows; by default CAM_FRONT.

    Raises BadInputError, with the file and what to do, for an unknown scene or camera, missing or damaged files.
    """

    def __init__(self, path: str | Path, camera: int | str | None = None) -> None:
        text, scene = split_scene(str(path))
        folder = tables_folder(Path(text))
        if folder is None:
            raise BadInputError(f"{text} is not a nuScenes folder; looked for {EXPECTED_NUSCENES}")
        self.path, self.recent = folder, Recent(0)  # scans that are kept
        self._records = self._read_scene(scene)
        if camera is None:
            camera = CAMERA if CAMERA in self.cameras else 0
        self.camera_frame = (dict(enumerate(self.cameras)) | {name: name for name in self.cameras}).get(camera, "")
        if not self.camera_frame:
            listed = ", ".join(f"{k} {name}" for k, name in enumerate(self.cameras))
            raise BadInputError(f"{self.path} has no camera {camera}; choose one of {listed}")
        scans = {scan.sample: scan for scan in self._of(self.lidar_frame) if scan.key}
        found = [(image, scans[image.sample]) for image in self._of(self.camera_frame) if image.key and image.sample in scans]
        self._pairs = [pair for pair in found if all((folder.parent / record.filename).is_file() for record in pair)]
        self._left_out = len(found) - len(self._pairs)
        if not self._pairs:
            raise BadInputError(
                f"{folder}: {self.name} has {len(found)} key frames of {self.camera_frame}, but none has its files in "
                f"{folder.parent / 'samples'}; download the part of the dataset that holds this scene, or choose another scene"
            )
        self.camera, self.reference = self._calibration(*self._pairs[0])

    def _read_scene(self, scene: str | None) -> list[Record]:
        """The rows of sample_data of a scene, in time; of the large tables no others are kept. Also learns name, scenes, cameras
        and lidar_frame."""
        folder = self.path
        by_name = {shown(row["name"]): row for row in self._rows("scene", ("name", "token"))}
        self.scenes = list(by_name)
        if not by_name or (scene is not None and scene not in by_name):
            has = ", ".join(self.scenes[:SHOWN_SCENES]) + (", ..." if len(by_name) > SHOWN_SCENES else "") or "none"
            raise BadInputError(f"{folder} has no scene {scene or 'at all'}; it has {has}; choose one by {folder.parent}#NAME")
        self.name = self.scenes[0] if scene is None else scene
        token = by_name[self.name]["token"]
        samples = {row["token"] for row in self._rows("sample", ("token",), lambda row: row.get("scene_token") == token)}
        sensors = {row["token"]: row for row in self._rows("sensor", ("token", "channel", "modality"))}
        self.cameras = sorted(shown(row["channel"]) for row in sensors.values() if row["modality"] == "camera")
        scanners = sorted(shown(row["channel"]) for row in sensors.values() if row["modality"] == "lidar")
        if not scanners or not self.cameras:
            raise BadInputError(f"{folder / 'sensor.json'} has no lidar or no camera; download the tables again")
        self.lidar_frame = LIDAR if LIDAR in scanners else scanners[0]
        channels = {token: shown(row["channel"]) for token, row in sensors.items()}
        wanted = {token for token, channel in channels.items() if channel in (self.lidar_frame, *self.cameras)}
        fields: tuple[str, ...] = ("token", "sensor_token", "translation", "rotation", "camera_intrinsic")

        def sensor(row: Row) -> tuple[str, Transform, Matrix]:
            return channels[row["sensor_token"]], _pose(row), _numbers(row["camera_intrinsic"])

        rows = self._rows("calibrated_sensor", fields, lambda row: row.get("sensor_token") in wanted)
        calibrated = {row["token"]: self._typed(row, sensor) for row in rows}
        fields = ("token", "sample_token", "ego_pose_token", "calibrated_sensor_token", "filename", "timestamp", "is_key_frame")

        def of_scene(row: Row) -> bool:
            return row.get("sample_token") in samples and row.get("calibrated_sensor_token") in calibrated

        def record(row: Row) -> Record:
            channel, T, K = calibrated[row["calibrated_sensor_token"]]
            size, stamp = (int(row.get("width") or 0), int(row.get("height") or 0)), np.int64(int(row["timestamp"]) * STAMP_NS)
            tokens = str(row["sample_token"]), str(row["ego_pose_token"])
            return Record(*tokens, channel, T, K, str(row["filename"]), int(stamp), bool(row["is_key_frame"]), size)

        records = [self._typed(row, record) for row in self._rows("sample_data", fields, of_scene)]
        return sorted(records, key=lambda own: own.stamp)

    def _of(self, channel: str) -> list[Record]:
        """What a sensor measured, in time."""
        return [record for record in self._records if record.channel == channel]

    def calibration_at(self, index: int) -> tuple[Matrix, Matrix]:
        """Camera matrix (3, 3) and T_camera_lidar (4, 4) of a frame, whose picture and scan are not read."""
        camera, T_camera_lidar = self._calibration(*self._pairs[index])
        return camera.K, T_camera_lidar

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> Frame:
        picture, scan = self._pairs[index]
        camera, reference = self._calibration(picture, scan)
        return Frame(
            image=read_image(self.path.parent / picture.filename),
            cloud=self._cloud(scan),
            camera=camera,
            stamp=picture.stamp,
            cloud_stamp=scan.stamp,
            reference=reference,
            name=str(scan.stamp // STAMP_NS),
            twist=self._twist(scan),
            compensated=True,
        )

    def scans(self) -> Timed:
        """All scans of the scene that are there, also between the key frames, with their stamps, ns."""
        found = [scan for scan in self._of(self.lidar_frame) if (self.path.parent / scan.filename).is_file()]
        return Timed(np.array([scan.stamp for scan in found], np.int64), lambda index: self._cloud(found[index]))

    def _cloud(self, scan: Record) -> PointCloud:
        path = self.path.parent / scan.filename
        return self.recent(path, lambda: read_sweep(path))

    def _calibration(self, picture: Record, scan: Record) -> tuple[Camera, Matrix]:
        return Camera(picture.K, *picture.size), se3.inverse(picture.T_ego_sensor) @ scan.T_ego_sensor

    def describe(self) -> dict[str, str]:
        """What the scene holds: label -> text."""
        others = [name for name in self.scenes if name != self.name]
        some = ", ".join(others[:SHOWN_SCENES]) + (", ..." if len(others) > SHOWN_SCENES else "")
        left_out = f"; left out: {self._left_out} whose files are missing" if self._left_out else ""
        return {
            "kind": f"nuScenes {self.path.name}",
            "path": str(self.path.parent),
            "scene": f"{self.name}; others, as PATH#NAME: {some or 'none'}",
            "frames": f"{len(self)} key frames{left_out}",
            "stamps": "of sample_data",
            "motion": "scans are compensated already; from their stamps to the images' by ego_pose",
            "cameras": ", ".join(f"{name}{' (chosen)' if name == self.camera_frame else ''}" for name in self.cameras),
            "camera": describe_camera(self.camera),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "from calibrated_sensor",
        }

    def _twist(self, scan: Record) -> Matrix | None:
        """(rx, ry, rz, tx, ty, tz) of the LiDAR at a scan's stamp, rad/s and m/s, in its own frame; None without neighbours."""
        stamps, poses = self._lidar_poses
        at = int(np.searchsorted(stamps, scan.stamp))
        near = [k for k in (at - 1, at, at + 1) if 0 <= k < len(stamps) and abs(stamps[k] - scan.stamp) <= MAX_GAP_NS]
        if len(near) < 2 or stamps[near[0]] == stamps[near[-1]]:
            return None
        T_first_last = se3.inverse(poses[near[0]]) @ poses[near[-1]]
        return np.asarray(se3.log(T_first_last) * (NANOSECONDS / (stamps[near[-1]] - stamps[near[0]])))

    @cached_property
    def _lidar_poses(self) -> tuple[NDArray[np.int64], list[Matrix]]:
        """Stamps (n,) in ns, and T_global_lidar, of all scans of the scene."""
        scans = self._of(self.lidar_frame)
        wanted = {scan.pose for scan in scans}
        rows = self._rows("ego_pose", ("token", "translation", "rotation"), lambda row: row.get("token") in wanted)
        poses = {row["token"]: self._typed(row, _pose) for row in rows}
        missing = len(wanted - poses.keys())
        if missing:
            raise BadInputError(f"{self.path / 'ego_pose.json'} lacks {missing} of {len(scans)} scans; download the tables again")
        return np.array([scan.stamp for scan in scans], np.int64), [poses[scan.pose] @ scan.T_ego_sensor for scan in scans]

    def _rows(self, table: str, fields: tuple[str, ...], keep: Callable[[Row], bool] = lambda _: True) -> list[Row]:
        """The rows to keep. Rows are dropped while the file is parsed: sample_data of the whole dataset has 2.6 million."""
        path = self.path / f"{table}.json"
        try:
            with path.open(encoding="utf-8") as file:
                rows = json.load(file, object_hook=lambda row: row if keep(row) else None)
        except OSError as error:
            raise BadInputError(f"{path} cannot be read ({error.strerror}); download the tables again") from error
        except (ValueError, TypeError, RecursionError):  # TypeError: a list where a token should be
            raise BadInputError(f"{path} is not valid JSON of nuScenes; download the tables again") from None
        if not isinstance(rows, list):
            raise BadInputError(f"{path} is not a table of nuScenes; download the tables again")
        kept = [row for row in rows if isinstance(row, dict)]
        for row in kept:
            wrong = [name for name in fields if name not in row or (name.endswith("token") and not isinstance(row[name], str))]
            if wrong:
                raise BadInputError(f"{path}: a row has no {', '.join(wrong)}; download the tables again")
        return kept

    def _typed(self, row: Row, convert: Callable[[Row], T]) -> T:
        try:
            return convert(row)
        except (BadInputError, TypeError, ValueError, OverflowError):
            raise BadInputError(
                f"{self.path}: the values of row {shown(row['token'])} are unusable; download the tables again"
            ) from None


def _pose(row: Row) -> Transform:
    """T_parent_child (4, 4) of translation and rotation (w, x, y, z)."""
    w, x, y, z = _numbers(row["rotation"])
    return se3.from_parts(se3.rotation_from_quaternion([x, y, z, w]), _numbers(row["translation"]).reshape(3))


def _numbers(value: Any) -> Matrix:
    numbers = np.array(value, float)
    if not np.isfinite(numbers).all():
        raise ValueError("not finite")
    return numbers


def read_sweep(path: Path) -> PointCloud:
    """A .pcd.bin of x, y, z, intensity and ring, five float32 a point, in the order of the file. BadInputError if damaged."""
    points = read_points(path, (5,))
    with np.errstate(invalid="ignore"):
        return PointCloud(np.ascontiguousarray(points[:, :3]), points[:, 3].copy(), points[:, 4].astype(np.int32))


def split_scene(text: str) -> tuple[str, str | None]:
    """'PATH#scene-0061' -> path and name of the scene; None without one."""
    path, mark, scene = text.rpartition("#")
    return (path, scene) if mark and not Path(text).expanduser().exists() else (text, None)


def tables_folder(path: Path) -> Path | None:
    """The folder with the tables: the path, or the only v1.0-* in it; None if there is none, BadInputError for several."""
    if not path.is_dir():
        return None
    found = [folder for folder in (path, *sorted(path.glob("v1.0-*"))) if (folder / "sample_data.json").is_file()]
    if len(found) > 1 and found[0] != path:
        raise BadInputError(f"{path} holds {', '.join(folder.name for folder in found)}; give one of them, as {found[0]}")
    return found[0] if found else None

"""Opening the recording of several cameras and LiDARs by the description of its sensors: of other packages, KITTI and nuScenes,
and of plain folders, one for each camera, with the clouds of LiDARs in folders of their own, or beside a camera's images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.camera import Camera
from calib_ros.datasets.camera_files import camera_file
from calib_ros.datasets.folder import CLOUDS, IMAGES, FolderSource
from calib_ros.datasets.open import is_bag, open_dataset
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.rig_source import (
    CAMERA,
    KEPT_CLOUDS,
    ByDescription,
    RecordedRig,
    RigDescription,
    RigSource,
    Sensor,
)
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.extensions import RIGS, source_of

__all__ = ["RecordedRig", "RigSource", "named_rig", "open_rig"]


def open_rig(path_or_text: str | Path, description: RigDescription, **options: Any) -> RigSource:
    """Open the recording of the rig that is described: a bag by the topics of its sensors; or a synthetic rig, nuScenes, KITTI or
    plain folders, where `topic` is the recording's own name of a sensor (nuScenes: channel; KITTI: number of the camera; plain
    folders: see `FolderRig`), by default its name.

    options : of a bag, see `BagSource`: tolerance_s, rectified, motion, windows, clock, incomplete.

    Raises BadInputError for other recordings, and for sensors that the recording does not have.
    """
    text, path = str(path_or_text), Path(path_or_text).expanduser()
    if not path.exists() and (rig := named_rig(text)) is not None:
        return ChosenSensors(rig, description)
    if path.exists() and is_bag(path):
        from calib_ros.datasets.bag_rig import BagRig

        return BagRig(path, description, **options)
    if is_folder_rig(path, description):
        return FolderRig(path, description)
    return OneLidarRig(text, description)


def named_rig(text: str) -> RecordedRig | None:
    """The rig that another package brings by its name, as "synthetic:rig=..."; None where the text is something else."""
    opened_by_name = None if Path(text).expanduser().exists() else source_of(text, RIGS)
    rig: RecordedRig | None = None if opened_by_name is None else opened_by_name(text)
    return rig


class ChosenSensors(ByDescription):
    """Some sensors of a rig, under the names of a description."""

    def __init__(self, rig: RigSource, description: RigDescription) -> None:
        super().__init__(rig.name, description)
        self.rig = rig
        self._own: dict[str, str] = {}
        for sensor in description.sensors:
            names = rig.cameras if sensor.kind == CAMERA else rig.lidars
            found = [name for name in (sensor.topic, sensor.name) if name in names]
            if not found:
                raise BadInputError(
                    f"{rig.name} has no {sensor.kind} {sensor.name}; name by topic one that it has: {', '.join(names) or 'none'}"
                )
            self._own[sensor.name] = found[0]

    def camera(self, name: str) -> Camera:
        """As of any rig."""
        return self.rig.camera(self._own[name])

    def frame_id(self, name: str) -> str:
        """As of any rig."""
        return self.sensors[name].frame or self.rig.frame_id(self._own[name])

    def reference(self, name: str) -> Transform | None:
        """As of any rig."""
        base, own = self.rig.reference(self._own[self.reference_sensor]), self.rig.reference(self._own[name])
        return None if base is None or own is None else np.asarray(se3.inverse(base) @ own)

    def pair(self, camera: str, lidar: str) -> Source:
        """As of any rig."""
        return self.rig.pair(self._own[camera], self._own[lidar])

    def scans(self, lidar: str) -> Timed:
        """As of any rig."""
        return self.rig.scans(self._own[lidar])


class OneLidarRig(ByDescription):
    """KITTI, nuScenes, ONCE: several cameras around one LiDAR; or any source of one camera and one LiDAR."""

    def __init__(self, text: str, description: RigDescription) -> None:
        super().__init__(text, description)
        if len(self.lidars) != 1 or not self.cameras:
            raise BadInputError(
                f"{text} has one LiDAR, but the description has {len(self.lidars)} and {len(self.cameras)} cameras; "
                "list the LiDAR and one camera or more"
            )
        recent, several = Recent(KEPT_CLOUDS), len(self.cameras) > 1
        self._sources: dict[str, Any] = {}
        for name in self.cameras:
            try:
                source: Any = open_dataset(text, self.sensors[name].topic or name)
            except BadInputError:
                source = None if several or self.sensors[name].topic else open_dataset(text)
                if source is None or len(getattr(source, "cameras", ())) > 1:  # the only one needs no name
                    raise
            if several and len(getattr(source, "cameras", ())) < 2:
                raise BadInputError(f"{text} has one camera, but the description has {', '.join(self.cameras)}; list that one")
            if hasattr(source, "recent"):
                source.recent = recent
            self._sources[name] = source

    def camera(self, name: str) -> Camera:
        """As of any rig."""
        camera: Camera = self._sources[name].camera
        return camera

    def frame_id(self, name: str) -> str:
        """As of any rig."""
        own = self._first.lidar_frame if name in self.lidars else self._sources[name].camera_frame
        return self.sensors[name].frame or str(own)

    def reference(self, name: str) -> Transform | None:
        """As of any rig; of nuScenes and KITTI objects, of the first frames."""
        base, own = (np.eye(4) if of in self.lidars else self._sources[of].reference for of in (self.reference_sensor, name))
        return None if base is None or own is None else np.asarray(base @ se3.inverse(own))

    def pair(self, camera: str, lidar: str) -> Source:
        """As of any rig."""
        self.lidars.index(lidar)
        source: Source = self._sources[camera]
        return source

    def scans(self, lidar: str) -> Timed:
        """As of any rig."""
        source = self._first
        if hasattr(source, "scans"):
            own: Timed = source.scans()
            return own
        stamps = np.array([source[k].moment_of_cloud for k in range(len(source))], np.int64)
        return Timed(stamps, lambda k: source[k].cloud)

    @property
    def _first(self) -> Any:
        return self._sources[self.cameras[0]]


class FolderRig(ByDescription):
    """Sub-folders of a folder, each `topic`, by default the name, of a sensor: of a camera as of `FolderSource`, of a LiDAR with
    clouds/. A LiDAR without a folder is that of the first camera which has clouds. Images and scans of one name belong together.

    Cameras without a calibration of their own are those, by name, of the file beside the folders. T_camera_lidar of a camera's
    calibration is to the LiDAR of its own clouds, else to the only one. BadInputError for what is missing.
    """

    def __init__(self, path: Path, description: RigDescription) -> None:
        super().__init__(path.resolve().name, description)
        self.path, self._recent = path, Recent(KEPT_CLOUDS)
        self._pairs: dict[tuple[str, str], FolderSource] = {}
        if not self.cameras or not self.lidars:
            raise BadInputError(f"{path} is opened by its cameras' folders; list one camera or more, and one LiDAR or more")
        self._folders = {name: folder_of(path, self.sensors[name]) for name in self.cameras}
        for name, folder in self._folders.items():
            if not (folder / IMAGES).is_dir():
                has = sorted(child.name for child in path.iterdir() if (child / IMAGES).is_dir())
                raise BadInputError(
                    f"{folder / IMAGES} of camera {name} is missing; name by sensors.{name}.topic a folder that is there: "
                    f"{', '.join(has) or '.'}"
                )
        with_clouds = [folder for folder in self._folders.values() if (folder / CLOUDS).is_dir()]
        for name in self.lidars:
            folder, given = folder_of(path, self.sensors[name]), self.sensors[name].topic
            if not (folder / CLOUDS).is_dir() and (given or not with_clouds or len(self.lidars) > 1):
                raise BadInputError(
                    f"{folder / CLOUDS} of LiDAR {name} is missing; name by sensors.{name}.topic a folder with {CLOUDS}/"
                )
            self._folders[name] = folder if (folder / CLOUDS).is_dir() else with_clouds[0]

    def camera(self, name: str) -> Camera:
        """As of any rig."""
        return self.pair(name, self._lidar_of(name) or self.lidars[0]).camera

    def frame_id(self, name: str) -> str:
        """By the description, else the camera's name in its calibration, or the LiDAR's own."""
        own = name if name in self.lidars else self.pair(name, self._lidar_of(name) or self.lidars[0]).camera_frame
        return self.sensors[name].frame or own

    def reference(self, name: str) -> Transform | None:
        """As of any rig; None of sensors which no calibration joins to the reference."""
        if self._lidar_of(name) is None or self._lidar_of(name) != self._lidar_of(self.reference_sensor):
            return None
        base, own = self._to_lidar(self.reference_sensor), self._to_lidar(name)
        return None if base is None or own is None else np.asarray(base @ se3.inverse(own))

    def pair(self, camera: str, lidar: str) -> FolderSource:
        """As of any rig; the reference is known to the LiDAR of the camera's calibration."""
        if (camera, lidar) not in self._pairs:
            folder, beside = self._folders[camera], camera_file(self.path)
            shared = beside if beside.is_file() and not camera_file(folder).is_file() else None
            choice = None if shared is None else self.sensors[camera].topic or camera
            source = FolderSource(folder, choice, self._folders[lidar] / CLOUDS, shared)
            source.recent = self._recent
            if self._lidar_of(camera) != lidar:
                source.reference = None
            self._pairs[camera, lidar] = source
        return self._pairs[camera, lidar]

    def scans(self, lidar: str) -> Timed:
        """The scans that any camera has an image with."""
        sources = [self.pair(camera, lidar) for camera in self.cameras]
        # Cameras may stamp one scan differently, where it has no stamp of its own.
        by_name = {name: (source, k) for source in reversed(sources) for k, name in enumerate(source.names)}
        found = {source.stamp_of_scan(k): (source, k) for source, k in by_name.values()}
        stamps = np.array(sorted(found), np.int64)

        def read(k: int) -> object:
            source, index = found[int(stamps[k])]
            return source.scan(index)[1]

        return Timed(stamps, read)

    def _lidar_of(self, name: str) -> str | None:
        """The LiDAR that a sensor's reference is to."""
        if name in self.lidars:
            return name
        own = [lidar for lidar in self.lidars if self._folders[lidar] == self._folders[name]]
        return (own or list(self.lidars))[0] if own or len(self.lidars) == 1 else None

    def _to_lidar(self, name: str) -> Transform | None:
        """T_sensor_lidar (4, 4)."""
        lidar = self._lidar_of(name)
        return np.eye(4) if name in self.lidars or lidar is None else self.pair(name, lidar).reference


def folder_of(path: Path, sensor: Sensor) -> Path:
    """Where the files of a sensor are."""
    return path / (sensor.topic or sensor.name).lstrip("/")


def is_folder_rig(path: Path, description: RigDescription) -> bool:
    """Whether a folder has the images of a camera that is described."""
    return any((folder_of(path, sensor) / IMAGES).is_dir() for sensor in description.sensors if sensor.kind == CAMERA)

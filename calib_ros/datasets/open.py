"""Opening a recording by its path or text: as a source of one pair, or as a rig, by the description of its sensors."""

from __future__ import annotations

import re
from inspect import signature
from pathlib import Path
from typing import Any, cast

from calib_ros.camera import Camera
from calib_ros.datasets.camera_files import camera_file, read_camera
from calib_ros.datasets.capture import CaptureSource, is_capture
from calib_ros.datasets.folder import (
    CLOUDS,
    EXPECTED_FOLDER,
    IMAGES,
    FolderRig,
    FolderSource,
    folder_sensors,
    is_folder_dataset,
    is_folder_rig,
)  # fmt: skip
from calib_ros.datasets.kitti import EXPECTED_FOLDERS, KittiSource, find_drive
from calib_ros.datasets.nuscenes import EXPECTED_NUSCENES, NuScenesSource, split_scene, tables_folder
from calib_ros.datasets.once import EXPECTED_ONCE, OnceSource, is_once
from calib_ros.datasets.rig import (
    CAMERA,
    LIDAR,
    ChosenSensors,
    DescribedRig,
    RecordedRig,
    RigDescription,
    RigSource,
    Sensor,
    ros_name,
)
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.extensions import RIGS, SOURCES, source_of
from calib_ros.extensions import names as installed

BAG_FILES = (".mcap", ".db3", ".bag")


def open_dataset(path_or_text: str | Path, camera: int | str | None = None, **options: Any) -> Source:
    """Open a bag, KITTI, nuScenes, ONCE or a plain folder, distinguished by content, or by its name what another package brings.

    Parameters
    ----------
    path_or_text : path of a bag, of what the node has captured (see `CaptureSource`), of a KITTI raw, odometry or object folder,
        of a folder with images/, clouds/ and calibration.yaml (see `FolderSource`), or of nuScenes (``"ROOT#scene-0061"``, by
        default the first scene; see `NuScenesSource`). Or ``"NAME[:...]"`` of an entry point ``calib_ros.sources``, such as
        ``"synthetic[:name=value,...]"``, the simulated drive.
    camera : of a KITTI folder, 0 to 3 (default 2; of KITTI-360 0 or 1), of nuScenes, its channel or number (default CAM_FRONT),
        of ONCE, a plain folder or a synthetic rig of several, a name or number in its calibration (default the first).
    **options : rectified, whether the pictures are already: the lens is not removed a second time. Of a bag or capture, see
        `BagSource`: image_topic, points_topic, camera_info_topic, tolerance_s, motion, T_camera_lidar, windows. None = default.

    Raises BadInputError if the path is none of these, or an option does not belong to the dataset.
    """
    options = {name: value for name, value in options.items() if value is not None}
    text = str(path_or_text)
    path = Path(text).expanduser()
    if isinstance(camera, str) and camera.isdecimal():
        camera = int(camera)
    opened_by_name = None if path.exists() else source_of(text)
    if opened_by_name is not None:
        choice: tuple[Any, ...] = () if camera is None else (camera,)
        return _said(_only_rectified(options, text), opened_by_name(text, *choice), camera)
    if not path.exists() and not is_nuscenes(path):
        by_name = "".join(f", or '{name}'" for name in installed(SOURCES))
        raise BadInputError(f"{text} does not exist; give a folder or a bag{by_name}")
    # Readers of bags are imported where needed: rosbags alone takes a third of a second.
    if not is_nuscenes(path) and (is_bag(path) or is_capture(path)):
        from calib_ros.datasets.bag import BagSource

        _only_rectified({name: options[name] for name in options.keys() - signature(BagSource).parameters}, text)
        return CaptureSource(path, **options) if is_capture(path) else BagSource(path, **options)
    readers = {is_nuscenes: NuScenesSource, is_folder_dataset: FolderSource, is_once: OnceSource, find_drive: KittiSource}
    for fits, reader in readers.items():
        if fits(path):
            return _said(_only_rectified(options, text), reader(path, camera), camera)
    if any(path.glob("lidar/*.pkl*")):
        raise BadInputError(
            f"{text}: PandaSet's scans are pickles, which run code where they are read; write x, y, z, i of pandas.read_pickle, "
            f"in the LiDAR's frame by the inverse of lidar/poses.json, to .npz files of {EXPECTED_FOLDER}"
        )
    if path.is_file():
        raise BadInputError(f"{text} is not a dataset; give a .mcap, .db3 or .bag file, a bag folder or a KITTI folder")
    names = sorted(child.name for child in path.iterdir())
    cameras = [name for name in names if (path / name / IMAGES).is_dir()]
    if cameras:
        raise BadInputError(
            f"{text} holds folders of cameras: {', '.join(cameras)}; give one that has {CLOUDS}/ as well, or estimate all "
            "sensors together with calib-ros rig"
        )
    found = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") if names else "nothing"
    raise BadInputError(
        f"{text} is not a dataset; looked for metadata.yaml, *.mcap, *.db3 or *.bag (bag), {EXPECTED_FOLDERS}, "
        f"{EXPECTED_NUSCENES}, {EXPECTED_ONCE}, {EXPECTED_FOLDER}; found {found}"
    )


open_source = open_dataset  # the former name


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


class OneLidarRig(DescribedRig):
    """KITTI, nuScenes, ONCE: several cameras around one LiDAR; or any source of one camera and one LiDAR."""

    def __init__(self, text: str, description: RigDescription) -> None:
        super().__init__(text, description)
        if len(self.lidars) != 1 or not self.cameras:
            raise BadInputError(
                f"{text} has one LiDAR, but the description has {len(self.lidars)} and {len(self.cameras)} cameras; "
                "list the LiDAR and one camera or more"
            )
        for name in self.cameras:
            self.pair(name, self.lidars[0])

    def open_pair(self, camera: Sensor, lidar: Sensor) -> Source:
        """The recording with a camera; the only one needs no name."""
        several = len(self.cameras) > 1
        try:
            source = open_dataset(self.name, camera.topic or camera.name)
        except BadInputError:
            if several or camera.topic:
                raise
            source = open_dataset(self.name)
            if len(getattr(source, "cameras", ())) > 1:
                raise
        if several and len(getattr(source, "cameras", ())) < 2:
            raise BadInputError(f"{self.name} has one camera, but the description has {', '.join(self.cameras)}; list that one")
        return source


def sensors_of(text: str) -> tuple[list[Sensor], list[str]]:
    """All sensors of a recording, as a description of them would open it, with priors where the recording knows what is believed;
    and remarks on what is left out of it. Raises as `open_dataset`."""
    path = Path(text).expanduser()
    if not path.exists() and (rig := named_rig(text)) is not None:
        of_kinds = (LIDAR, rig.lidars), (CAMERA, rig.cameras)
        return [Sensor(name, kind, prior=rig.prior(name)) for kind, names in of_kinds for name in names], []
    if path.exists() and is_bag(path):
        from calib_ros.datasets.bag_rig import bag_sensors

        return bag_sensors(path)
    if found := list(folder_sensors(path)):
        return found, []
    source = open_dataset(text)
    names = getattr(source, "cameras", ())
    found = [Sensor(name if re.match("[A-Za-z]", name) else f"{CAMERA}_{name}", CAMERA, name) for name in names]
    return [Sensor(ros_name(source.lidar_frame), LIDAR), *(found or [Sensor(ros_name(source.camera_frame), CAMERA)])], []


def is_bag(path: Path) -> bool:
    """Whether a path is a bag of ROS 1 or 2, intact or not."""
    if path.is_file():
        return path.name.removesuffix(".zstd").endswith(BAG_FILES)
    names = {file.name.removesuffix(".zstd") for file in path.iterdir() if file.is_file()} if path.is_dir() else set()
    if "metadata.yaml" in names or any(name.endswith((".mcap", ".db3")) for name in names):
        return True
    # Beside ROS 1 bags lie the data sets that were made from them, or the other way round.
    return any(name.endswith(".bag") for name in names) and not is_folder_dataset(path) and find_drive(path) is None


def is_single(path: Path) -> bool:
    """Whether a path is one source. KITTI drives are found from above, see `drives_in`."""
    return is_bag(path) or is_capture(path) or is_folder_dataset(path) or is_nuscenes(path) or is_once(path)


def is_nuscenes(path: Path) -> bool:
    """Whether a path is nuScenes, with or without ``#SCENE``."""
    return tables_folder(Path(split_scene(str(path))[0])) is not None


def _only_rectified(options: dict[str, Any], source: str) -> bool:
    """Whether pictures are said to be rectified. BadInputError for other options, which only bags have."""
    if others := sorted(options.keys() - {"rectified"}):
        raise BadInputError(f"{source} has no option {', '.join(others)}; leave it out")
    return bool(options.get("rectified"))


def _said(rectified: bool, source: Any, camera: int | str | None) -> Source:
    """A source. Of rectified pictures, its camera is P of a folder's calibration, or K, without distortion."""
    own = source.camera
    if rectified and isinstance(source, FolderSource):
        source.camera = read_camera(camera_file(source.path), camera, lambda: (own.width, own.height), rectified)[0]
    elif rectified and not own.is_pinhole:
        source.camera = Camera(own.K, own.width, own.height, said_rectified=True)
    return cast(Source, source)

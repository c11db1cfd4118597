"""Opening a dataset by its path or description."""

from __future__ import annotations

from inspect import signature
from pathlib import Path
from typing import Any

from calib_ros.datasets.capture import CaptureSource, is_capture
from calib_ros.datasets.folder import CLOUDS, EXPECTED_FOLDER, IMAGES, FolderSource, is_folder_dataset
from calib_ros.datasets.kitti import EXPECTED_FOLDERS, KittiSource, find_drive
from calib_ros.datasets.nuscenes import EXPECTED_NUSCENES, NuScenesSource, split_scene, tables_folder
from calib_ros.datasets.once import EXPECTED_ONCE, OnceSource, is_once
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.extensions import SOURCES, source_of
from calib_ros.extensions import names as installed

BAG_FILES = (".mcap", ".db3", ".bag")

__all__ = ["Source", "open_dataset", "open_source"]


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
    **options : of a bag or capture, see `BagSource`: image_topic, points_topic, camera_info_topic, tolerance_s, rectified,
        motion, T_camera_lidar, windows; None = default.

    Raises BadInputError if the path is none of these, or an option does not belong to the dataset.
    """
    options = {name: value for name, value in options.items() if value is not None}
    text = str(path_or_text)
    path = Path(text).expanduser()
    if isinstance(camera, str) and camera.isdecimal():
        camera = int(camera)
    opened_by_name = None if path.exists() else source_of(text)
    if opened_by_name is not None:
        _refuse(options, text)
        named: Source = opened_by_name(text) if camera is None else opened_by_name(text, camera)
        return named
    if not path.exists() and not is_nuscenes(path):
        by_name = "".join(f", or '{name}'" for name in installed(SOURCES))
        raise BadInputError(f"{text} does not exist; give a folder or a bag{by_name}")
    # Readers of bags are imported where needed: rosbags alone takes a third of a second.
    if not is_nuscenes(path) and (is_bag(path) or is_capture(path)):
        from calib_ros.datasets.bag import BagSource

        known = list(signature(BagSource).parameters)[1:]
        _refuse({name: options[name] for name in options.keys() - known}, text)
        return CaptureSource(path, **options) if is_capture(path) else BagSource(path, **options)
    for fits, reader in ((is_nuscenes, NuScenesSource), (is_folder_dataset, FolderSource), (is_once, OnceSource)):
        if fits(path):
            _refuse(options, text)
            return reader(path, camera)
    if any(path.glob("lidar/*.pkl*")):
        raise BadInputError(
            f"{text}: PandaSet's scans are pickles, which run code where they are read; write x, y, z, i of pandas.read_pickle, "
            f"in the LiDAR's frame by the inverse of lidar/poses.json, to .npz files of {EXPECTED_FOLDER}"
        )
    folder = find_drive(path) if path.is_dir() else None
    if folder is not None:
        _refuse(options, text)
        if isinstance(camera, str):
            raise BadInputError(f"{text} has no camera {camera}; KITTI's are numbers from 0 to 3")
        return KittiSource(folder, camera)
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


def _refuse(options: dict[str, Any], source: str) -> None:
    if options:
        raise BadInputError(f"{source} has no option {', '.join(sorted(options))}; leave it out")

"""Plain folders of images and clouds of the same names, with a calibration as ROS camera_calibration writes it: of a pair, or one
for each sensor of a rig."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib_ros.datasets.camera_files import camera_file, read_camera
from calib_ros.datasets.cloud_files import CLOUD_SUFFIXES, FOREIGN, TEXT_SUFFIXES, read_cloud
from calib_ros.datasets.recent import Recent, Timed
from calib_ros.datasets.rig import CAMERA, LIDAR, DescribedRig, RigDescription, Sensor, ros_name
from calib_ros.datasets.source import describe_camera
from calib_ros.errors import BadInputError
from calib_ros.frame import NANOSECONDS, Frame, PointCloud
from calib_ros.messages.image_encodings import picture_to_bgr
from calib_ros.messages.pictures import read_picture
from calib_ros.messages.wire import shown

IMAGES, CLOUDS, CALIBRATION, TIMES = "images", "clouds", "calibration.yaml", "times.csv"
EXPECTED_FOLDER = f"{IMAGES}/, {CLOUDS}/ and {CALIBRATION} (plain folder)"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
BESIDE = (*TEXT_SUFFIXES, ".tif", ".tiff", ".webp")  # beside a file of another format, they are of something else
PERIOD_NS = NANOSECONDS // 10  # between frames without times.csv: most scanners turn at 10 Hz
MAX_STAMP = 2**63
SHOWN_NAMES = 5  # of files without partner


class FolderSource:
    """Frames of a folder: images/NAME.png and the like with clouds/NAME.pcd and the like, calibration.yaml, and times.csv.

    A frame is a name with an image and a cloud; files are read on access. calibration.yaml is what ROS camera_calibration writes,
    with an optional T_camera_lidar (four rows), or a file of `camera_files`, of which `camera` is a name or number. times.csv has
    the columns name, image_ns and, where known, cloud_ns; frames are in the order of their image's stamp, without it in the order
    of their names, 0.1 s apart. Of a rig, clouds is the folder of a LiDAR's clouds, among which frames without times.csv are
    counted, and calibration a file beside the sensors' folders.

    Raises BadInputError, with the file and what to do, for missing, contradictory or damaged files.
    """

    lidar_frame = "lidar"

    def __init__(
        self, path: str | Path, camera: int | str | None = None, clouds: Path | None = None, calibration: Path | None = None
    ) -> None:
        self.path, self.recent = Path(path), Recent(0)
        self.name = self.path.resolve().name
        self._images = named_files(self.path / IMAGES, IMAGE_SUFFIXES)
        self._calibration = calibration or camera_file(self.path)
        first = self._images[min(self._images, key=_natural)] if self._images else None
        read = read_camera(self._calibration, camera, lambda: read_picture(first, "image").shape[1::-1] if first else (0, 0))
        self.camera, self.reference, self.camera_frame, self._other_cameras = read
        folder = clouds or self.path / CLOUDS
        self._clouds = named_files(folder, CLOUD_SUFFIXES)
        names = sorted(self._images.keys() & self._clouds.keys(), key=_natural)
        if not names:
            parts = (self.path / IMAGES, self._images, IMAGE_SUFFIXES), (folder, self._clouds, CLOUD_SUFFIXES)
            for part, found, known in parts:
                if not found:
                    raise BadInputError(_nothing_readable(part, known))
            raise BadInputError(
                f"{self.path}: no name has both an image ({len(self._images)} in {IMAGES}) and a cloud ({len(self._clouds)} in "
                f"{CLOUDS if clouds is None else clouds}); give the two files of a frame the same name, like {IMAGES}/000000.png "
                f"and {CLOUDS}/000000.pcd"
            )
        self._has_times = (self.path / TIMES).exists()
        if self._has_times:
            self._stamps = _read_times(self.path / TIMES, names)
            names.sort(key=lambda name: self._stamps[name][0])
        else:
            counted = names if clouds is None else sorted(self._clouds, key=_natural)
            self._stamps = {name: (k * PERIOD_NS, None) for k, name in enumerate(counted)}
        self.names = names
        self._read_image(names[0])

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, index: int) -> Frame:
        name = self.names[index]
        image_ns, cloud_ns = self._stamps[name]
        image, cloud = self._read_image(name), self.scan(index)[1]
        return Frame(image, cloud, self.camera, image_ns, cloud_ns, reference=self.reference, name=name)

    def scan(self, index: int) -> tuple[int, PointCloud]:
        """The scan of a frame with its stamp, ns, which is the image's where the scan has none."""
        path, stamp = self._clouds[self.names[index]], self.stamp_of_scan(index)
        return stamp, self.recent((path, stamp), lambda: read_cloud(path, stamp))

    def stamp_of_scan(self, index: int) -> int:
        """That stamp."""
        image_ns, cloud_ns = self._stamps[self.names[index]]
        return image_ns if cloud_ns is None else cloud_ns

    def describe(self) -> dict[str, str]:
        """What the folder holds: label -> text."""
        first = self[0].cloud
        fields = [name for name in ("intensity", "ring", "time") if getattr(first, name) is not None]
        unused = _alone(self._images, self._clouds, "image", "cloud"), _alone(self._clouds, self._images, "cloud", "image")
        left_out = "; ".join(text for text in unused if text) or "none"
        return {
            "kind": "folder",
            "path": str(self.path),
            "frames": f"{len(self)}, names {self.names[0]} to {self.names[-1]}; left out: {left_out}",
            "stamps": TIMES if self._has_times else f"none, no {TIMES}: the vehicle's motion is not corrected",
            "points": f"{len(first)} in the first cloud, with {', '.join(['x, y, z', *fields])}",
            "camera": describe_camera(self.camera) + "".join(f"; not {name}" for name in self._other_cameras),
            "camera_frame": self.camera_frame,
            "lidar_frame": self.lidar_frame,
            "reference": "none" if self.reference is None else f"T_camera_lidar of {self._calibration.name}",
        }

    def _read_image(self, name: str) -> NDArray[np.uint8]:
        path, picture = self._images[name], read_picture(self._images[name], "image")
        height, width = picture.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise BadInputError(
                f"image {path} is {width}x{height}, but {self._calibration.name} says {self.camera.width}x{self.camera.height}; "
                "give the calibration that belongs to images of this size"
            )
        return picture_to_bgr(picture)


def is_folder_dataset(path: Path) -> bool:
    """Whether a path looks like such a folder, complete or not."""
    parts = [(path / IMAGES).is_dir(), (path / CLOUDS).is_dir(), camera_file(path).is_file()]
    return sum(parts) >= 2


class FolderRig(DescribedRig):
    """Sub-folders of a folder, each `topic`, by default the name, of a sensor: of a camera as of `FolderSource`, of a LiDAR with
    clouds/. A LiDAR without a folder is that of the first camera which has clouds. Images and scans of one name belong together.

    Cameras without a calibration of their own are those, by name, of the file beside the folders. T_camera_lidar of a camera's
    calibration is to the LiDAR of its own clouds, else to the only one. BadInputError for what is missing.
    """

    def __init__(self, path: Path, description: RigDescription) -> None:
        super().__init__(path.resolve().name, description)
        self.path = path
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

    def frame_id(self, name: str) -> str:
        """By the description, else the camera's name in its calibration, or the LiDAR's own."""
        return self.sensors[name].frame or name if name in self.lidars else super().frame_id(name)

    def open_pair(self, camera: Sensor, lidar: Sensor) -> FolderSource:
        """The reference is known to the LiDAR of the camera's calibration."""
        folder, beside = self._folders[camera.name], camera_file(self.path)
        shared = beside if beside.is_file() and not camera_file(folder).is_file() else None
        choice = None if shared is None else camera.topic or camera.name
        source = FolderSource(folder, choice, self._folders[lidar.name] / CLOUDS, shared)
        if self.lidar_of(camera.name) != lidar.name:
            source.reference = None
        return source

    def scans(self, lidar: str) -> Timed:
        """The scans that any camera has an image with."""
        sources: list[FolderSource] = [self.pair(camera, lidar) for camera in self.cameras]
        # Cameras may stamp one scan differently, where it has no stamp of its own.
        by_name = {name: (source, k) for source in reversed(sources) for k, name in enumerate(source.names)}
        found = {source.stamp_of_scan(k): (source, k) for source, k in by_name.values()}
        stamps = np.array(sorted(found), np.int64)

        def read(k: int) -> object:
            source, index = found[int(stamps[k])]
            return source.scan(index)[1]

        return Timed(stamps, read)

    def lidar_of(self, name: str) -> str | None:
        """The LiDAR of a camera's own clouds, else the only one."""
        own = [lidar for lidar in self.lidars if name in self.cameras and self._folders[lidar] == self._folders[name]]
        return own[0] if own else super().lidar_of(name)


def folder_of(path: Path, sensor: Sensor) -> Path:
    """Where the files of a sensor are."""
    return path / (sensor.topic or sensor.name).lstrip("/")


def is_folder_rig(path: Path, description: RigDescription) -> bool:
    """Whether a folder has the images of a camera that is described."""
    return any((folder_of(path, sensor) / IMAGES).is_dir() for sensor in description.sensors if sensor.kind == CAMERA)


def folder_sensors(path: Path) -> Iterator[Sensor]:
    """A LiDAR of each folder in a folder with clouds, but one of those that hold the same files, and a camera of each with
    images; none where no folder has images."""
    folders = sorted(child for child in path.iterdir() if child.is_dir()) if path.is_dir() else []
    cameras = [child for child in folders if (child / IMAGES).is_dir()]
    of_clouds: dict[tuple[tuple[str, int], ...], Path] = {}
    for folder in (child for child in folders if cameras and (child / CLOUDS).is_dir()):
        files = named_files(folder / CLOUDS, CLOUD_SUFFIXES)
        of_clouds.setdefault(tuple((name, file.stat().st_size) for name, file in files.items()), folder)
    for folder in of_clouds.values():
        name = ros_name(folder.name)
        lidar = (name if LIDAR in name else f"{name}_{LIDAR}") if len(of_clouds) > 1 else LIDAR
        yield Sensor(lidar if folder in cameras else name, LIDAR, folder.name)
    for folder in cameras:
        yield Sensor(ros_name(folder.name), CAMERA, folder.name)


def named_files(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Files of a folder with one of these endings: name -> path. Empty without the folder; BadInputError for a name twice."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if path.suffix.lower() not in suffixes or path.name.startswith("."):
            continue
        first = found.get(path.stem)
        if first is not None and (path.suffix in BESIDE) != (first.suffix in BESIDE):
            found[path.stem] = first if path.suffix in BESIDE else path
            continue
        if first is not None:
            raise BadInputError(f"{folder}: {found[path.stem].name} and {path.name} are of the same frame; keep one of them")
        found[path.stem] = path
    return found


def _nothing_readable(folder: Path, known: tuple[str, ...]) -> str:
    """What to do about a folder without a file that is read."""
    if not folder.is_dir():
        return f"{folder} is missing; put the frames' files there: {', '.join(known)}"
    others = sorted({path.suffix.lower() for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")})
    if not others:
        return f"{folder} is empty; put the frames' files there: {', '.join(known)}"
    why = "; ".join(f"{suffix} is {FOREIGN[suffix]}" for suffix in others if suffix in FOREIGN)
    has = ", ".join(suffix or "files without an ending" for suffix in others)
    return f"{folder} has only {has}; {why or 'convert them'}; read are {', '.join(known)}"


def _read_times(path: Path, names: list[str]) -> dict[str, tuple[int, int | None]]:
    """Stamps, ns, of each frame's image and, if given, cloud."""
    stamps: dict[str, tuple[int, int | None]] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file, skipinitialspace=True)
            if not {"name", "image_ns"} <= {(column or "").strip() for column in table.fieldnames or ()}:
                raise BadInputError(f"{path} needs a first line 'name,image_ns,cloud_ns', and a line for each frame")
            for row in table:
                values = {(column or "").strip(): (text or "").strip() for column, text in row.items() if isinstance(text, str)}
                where, name, cloud = f"{path}, line {table.line_num}", values.get("name", ""), values.get("cloud_ns")
                if name in stamps:
                    raise BadInputError(f"{where}: frame {shown(name)} has stamps already; keep one line for each frame")
                stamps[name] = _stamp(values.get("image_ns", ""), where), _stamp(cloud, where) if cloud else None
    except OSError as error:
        raise BadInputError(f"{path} cannot be read ({error.strerror}); check the file") from error
    except (UnicodeDecodeError, csv.Error):
        raise BadInputError(f"{path} is not a table in UTF-8; write it again as name,image_ns,cloud_ns") from None
    missing = [name for name in names if name not in stamps]
    if missing:
        raise BadInputError(f"{path} has no line for frame {missing[0]} ({len(missing)} of {len(names)} missing); add its stamps")
    return stamps


def _stamp(text: str, where: str) -> int:
    try:
        stamp = int(text)
    except ValueError:
        stamp = MAX_STAMP
    if abs(stamp) >= MAX_STAMP:
        raise BadInputError(f"{where}: '{shown(text)}' is no stamp; give whole nanoseconds")
    return stamp


def _natural(name: str) -> tuple[int, int, str]:
    """Order of names: numbers by value, before other names by letters."""
    return (0, int(name), name) if name.isdecimal() else (1, 0, name)


def _alone(files: dict[str, Path], others: dict[str, Path], kind: str, other: str) -> str:
    """'2 images without cloud (000003.jpg, 000007.jpg)'; empty if every file has a partner."""
    alone = [files[name].name for name in files if name not in others]
    some = ", ".join(shown(name) for name in alone[:SHOWN_NAMES]) + (", ..." if len(alone) > SHOWN_NAMES else "")
    return f"{len(alone)} {kind}{'s' if len(alone) > 1 else ''} without {other} ({some})" if alone else ""

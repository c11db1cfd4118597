"""A rig without a description: the sensors of its recording, where that states them to be, and which one is the reference."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from calib_ros import se3
from calib_ros.arrays import Transform
from calib_ros.datasets.cloud_files import CLOUD_SUFFIXES
from calib_ros.datasets.folder import CLOUDS, IMAGES, named_files
from calib_ros.datasets.open import is_bag, open_dataset
from calib_ros.datasets.rig import named_rig, open_rig
from calib_ros.datasets.rig_source import CAMERA, LIDAR, RigDescription, RigSource, Sensor
from calib_ros.errors import BadInputError
from calib_ros.rig.edges import SEEN, seen_share

# Parts of topics that say what a message is, not of which sensor.
NO_NAME = re.compile(r"(image|points?|point_?cloud2?|cloud|scan|raw|rect|rectified|colou?r|mono|bgr|rgb|compressed|ffmpeg|_)*")
NO_SENSORS = {"base_link", "base_footprint", "odom", "map", "earth"}  # frames of REP 105
Remarks = list[str]


def recorded_rig(text: str) -> tuple[RigDescription, RigSource, Remarks]:
    """What a recording states of its sensors, the rig, and what there is to say of the choice.

    Priors are the poses that the recording states, relative to the LiDAR that most cameras share a view with; None where it
    states none. Raises BadInputError where there is no camera or no LiDAR.
    """
    sensors, remarks = _sensors_of(text)
    kinds = {kind: [own.name for own in sensors if own.kind == kind] for kind in (CAMERA, LIDAR)}
    for kind, names in kinds.items():
        if not names:
            raise BadInputError(f"{text} has no {kind} that can be read; {'; '.join([*remarks, 'give --rig a description'])}")
    rig = open_rig(text, RigDescription(tuple(sensors), kinds[LIDAR][0]))
    several = len(kinds[LIDAR]) > 1
    poses = {lidar: _poses(rig, sensors, lidar) for lidar in kinds[LIDAR]}
    reference = max(kinds[LIDAR], key=lambda lidar: _cameras_with(rig, lidar, poses[lidar]) if several else 0)
    rig.reference_sensor = reference
    named = [replace(own, prior=None if own.name == reference else poses[reference][own.name]) for own in sensors]
    why = ", with which most cameras share a view" if several else ""
    cameras, lidars = map(", ".join, kinds.values())
    remarks.append(f"as recorded: cameras {cameras}; LiDARs {lidars}; poses are relative to {reference}{why}")
    return RigDescription(tuple(named), reference), rig, remarks


def joined(description: RigDescription, text: str, remarks: Remarks) -> RigDescription:
    """The sensors whose poses are known; of the others a remark is added. BadInputError where there is no camera among them."""
    known = tuple(own for own in description.sensors if own.prior is not None or own.name == description.reference)
    lost = [own.name for own in description.sensors if own not in known]
    cure = "record /tf_static, or set their prior in the file that --write-rig writes and give it with --rig"
    if not any(own.kind == CAMERA for own in known):
        unknown = f"{text} does not state where {', '.join(lost)} are relative to {description.reference}; {cure}"
        raise BadInputError("; ".join([unknown, *remarks]))
    remarks += [f"left out, since the recording does not state where they are: {', '.join(lost)}; {cure}"] if lost else []
    return replace(description, sensors=known)


def _poses(rig: RigSource, sensors: Sequence[Sensor], reference: str) -> dict[str, Transform | None]:
    """T_reference_sensor (4, 4) of all sensors by what is believed of them, else as recorded; None where that is not said."""
    rig.reference_sensor = reference
    base = next((own.prior for own in sensors if own.name == reference), None)
    if base is None:
        return {own.name: rig.reference(own.name) for own in sensors}
    return {own.name: None if own.prior is None else se3.inverse(base) @ own.prior for own in sensors}


def _cameras_with(rig: RigSource, lidar: str, poses: dict[str, Transform | None]) -> int:
    """How many cameras share a view with a LiDAR, by its middle scan. poses: (4, 4) relative to it."""
    scans = rig.scans(lidar)
    xyz = scans[len(scans) // 2][1].xyz if len(scans) else np.zeros((0, 3))
    points = xyz[np.isfinite(xyz).all(axis=1)].astype(float)
    at = {name: T for name in rig.cameras if (T := poses[name]) is not None}
    return sum(seen_share(rig.camera(name), se3.inverse(T), points) >= SEEN for name, T in at.items())


def _sensors_of(text: str) -> tuple[list[Sensor], Remarks]:
    """All sensors of a recording, and what is left out of it."""
    path = Path(text).expanduser()
    if not path.exists() and (rig := named_rig(text)) is not None:
        of_kinds = (LIDAR, rig.lidars), (CAMERA, rig.cameras)
        return [Sensor(name, kind, prior=rig.prior(name)) for kind, names in of_kinds for name in names], []
    if path.exists() and is_bag(path):
        return _of_bag(path)
    folders = sorted(child for child in path.iterdir() if child.is_dir()) if path.is_dir() else []
    if any((child / IMAGES).is_dir() for child in folders):
        return list(_of_folders(folders)), []
    source = open_dataset(text)
    names = getattr(source, "cameras", ())
    found = [Sensor(name if re.match("[A-Za-z]", name) else f"{CAMERA}_{name}", CAMERA, name) for name in names]
    return [Sensor(_token(source.lidar_frame), LIDAR), *(found or [Sensor(_token(source.camera_frame), CAMERA)])], []


def _of_bag(path: Path) -> tuple[list[Sensor], Remarks]:
    """A sensor for every frame that messages come from: of the topics of one frame, the rectified image and the densest cloud."""
    from calib_ros.datasets.bag_file import BagFile, peek_header
    from calib_ros.datasets.bag_topics import choose_camera_info, clouds, info_beside, is_rectified, pictures

    bag = BagFile(path)
    images = pictures(bag)
    first = {topic: data for own in (*images, *clouds(bag)) for topic, _, data in islice(bag.raw([own]), 1)}
    frames = {topic: peek_header(data)[1] for topic, data in first.items()}
    infos = {topic: info_beside(bag, topic) for topic in images}
    if len(images) == 1:
        infos[images[0]] = choose_camera_info(bag, None, images[0])
    left = {topic: "no CameraInfo is beside it" for topic in images if not infos[topic]}
    left |= {t: f"{frame} is no frame of a sensor, as merged clouds have" for t, frame in frames.items() if frame in NO_SENSORS}
    best: dict[tuple[bool, str], str] = {}  # topic of what comes from a frame
    for topic in sorted(first.keys() - left.keys(), key=lambda t: (is_rectified(t) if t in images else len(first[t]), t)):
        of = topic in images, frames[topic] or topic
        if of in best:
            left[best[of]] = f"{topic} is of the same frame"
        best[of] = topic
    kept = [topic for topic in first if topic not in left]
    kept.sort(key=lambda topic: (topic in images, topic))
    names, used = _names(kept), Counter(frames[topic] for topic in kept)
    own = {topic: frames[topic] if used[frames[topic]] == 1 else "" for topic in kept}  # "" as recorded
    sensors = [Sensor(names[t], CAMERA if t in images else LIDAR, t, infos.get(t, ""), own[t]) for t in kept]
    return sensors, [f"{topic} is left out: {why}" for topic, why in left.items()]


def _of_folders(folders: Sequence[Path]) -> Iterator[Sensor]:
    """A LiDAR of each folder with clouds, but one of those that hold the same files, and a camera of each with images."""
    of_clouds: dict[tuple[tuple[str, int], ...], Path] = {}
    for folder in (child for child in folders if (child / CLOUDS).is_dir()):
        files = named_files(folder / CLOUDS, CLOUD_SUFFIXES)
        of_clouds.setdefault(tuple((name, file.stat().st_size) for name, file in files.items()), folder)
    for folder in of_clouds.values():
        name, own = _token(folder.name), (folder / IMAGES).is_dir()
        lidar = (name if LIDAR in name else f"{name}_{LIDAR}") if len(of_clouds) > 1 else LIDAR
        yield Sensor(lidar if own else name, LIDAR, folder.name)
    for folder in (child for child in folders if (child / IMAGES).is_dir()):
        yield Sensor(_token(folder.name), CAMERA, folder.name)


def _names(topics: Sequence[str]) -> dict[str, str]:
    """'/front/image_raw' -> 'front'; names that differ, of which each can be part of a topic's."""
    named: dict[str, str] = {}
    for topic in topics:
        parts = [part for part in topic.split("/") if part and not NO_NAME.fullmatch(part)]
        names = "_".join(parts) or topic, topic, *(f"{topic}_{k}" for k in range(2, len(topics) + 2))
        named[topic] = next(own for own in map(_token, names) if own not in named.values())
    return named


def _token(text: str) -> str:
    """What a name of ROS can be made of."""
    token = re.sub(r"[^A-Za-z0-9]+", "_", text).strip("_")
    return token if re.match("[A-Za-z]", token) else f"sensor_{token}"

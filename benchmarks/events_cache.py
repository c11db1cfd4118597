"""Frames of a source kept in a folder, rendered ahead by a process of its own.

A file holds the image as PNG and of the cloud what lies around the camera's view, both exact; the LiDAR's other points cost two
thirds of the space and none of them is ever compared with an image.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import time
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib_ros import se3
from calib_ros.datasets.source import Source
from calib_ros.errors import BadInputError
from calib_ros.frame import Frame, PointCloud

MARGIN_DEG = 20.0  # on either side of the camera's view
PATIENCE_S = 0.05


def in_front(frame: Frame) -> PointCloud:
    """The points whose azimuth about the camera lies in the view, or near it."""
    if frame.reference is None:
        return frame.cloud
    points = se3.transform(frame.reference, frame.cloud.xyz)
    K, width = frame.camera.K, frame.camera.width
    left, right = np.arctan2(K[0, 2], K[0, 0]), np.arctan2(width - K[0, 2], K[0, 0])
    azimuth, margin = np.arctan2(points[:, 0], points[:, 2]), np.deg2rad(MARGIN_DEG)
    return frame.cloud.select((azimuth > -left - margin) & (azimuth < right + margin))


def packed(values: np.ndarray) -> np.ndarray:
    """Any array -> (n,) uint8, smaller. Bytes of equal weight side by side: the upper ones of neighbours are alike."""
    planes = np.ascontiguousarray(values).reshape(-1).view(np.uint8).reshape(-1, values.dtype.itemsize).T
    return np.frombuffer(zlib.compress(planes.tobytes(), 1), np.uint8)


def unpacked(data: np.ndarray, dtype: type, *shape: int) -> np.ndarray:
    """The array of `packed`."""
    planes = np.frombuffer(zlib.decompress(data.tobytes()), np.uint8).reshape(np.dtype(dtype).itemsize, -1)
    return np.ascontiguousarray(planes.T).view(dtype).reshape(-1, *shape)


def save(path: Path, frame: Frame) -> None:
    """Write a frame; the file is there whole or not at all."""
    cloud = in_front(frame)
    fields = {name: values for name in ("intensity", "ring", "time") if (values := getattr(cloud, name)) is not None}
    fields |= {"xyz": cloud.xyz}
    arrays: dict[str, Any] = {f"cloud_{name}": packed(values) for name, values in fields.items()}
    arrays |= {"image": cv2.imencode(".png", frame.image, [cv2.IMWRITE_PNG_COMPRESSION, 2])[1]}
    arrays |= {"stamps": np.array([frame.stamp, frame.moment_of_cloud]), "name": np.array(frame.name)}
    arrays |= {name: values for name in ("reference", "twist") if (values := getattr(frame, name)) is not None}
    part = path.with_suffix(f".{os.getpid()}.part")
    with part.open("wb") as file:
        np.savez(file, compensated=frame.compensated, **arrays)
    part.replace(path)


def load(path: Path, camera: Any) -> Frame:
    """The frame of `save`, without the points far beside the view."""
    with np.load(path) as data:
        xyz = unpacked(data["cloud_xyz"], np.float32, 3)
        types = {"intensity": np.float32, "ring": np.int32, "time": np.float32}
        fields = {name: unpacked(data[f"cloud_{name}"], t) for name, t in types.items() if f"cloud_{name}" in data}
        stamp, cloud_stamp = (int(v) for v in data["stamps"])
        return Frame(
            np.asarray(cv2.imdecode(data["image"], cv2.IMREAD_UNCHANGED), np.uint8),
            PointCloud(xyz, fields.get("intensity"), fields.get("ring"), fields.get("time")),
            camera,
            stamp,
            cloud_stamp,
            data.get("reference"),
            str(data["name"]),
            data.get("twist"),
            bool(data["compensated"]),
        )


class Cached:
    """A source whose frames come from `folder` once they have been there. times: as the source's.

    what: text that says all that the frames rest on. BadInputError when the folder holds frames of something else. Use as a
    context: with `ahead`, another process renders all that is missing meanwhile, in order.
    """

    def __init__(self, source: Source, folder: Path, what: str, ahead: bool = True) -> None:
        self.source, self.folder, self._ahead = source, folder, ahead
        self.name, self.camera, self.reference = source.name, source.camera, source.reference
        self.camera_frame, self.lidar_frame = source.camera_frame, source.lidar_frame
        self.times = source.times  # type: ignore[attr-defined]
        self._worker: Any = None
        folder.mkdir(parents=True, exist_ok=True)
        label = folder / "what.json"
        if not label.exists():
            label.write_text(json.dumps(what))
        held = json.loads(label.read_text())
        if held != what:
            raise BadInputError(f"{folder} holds frames of something else ({held}); give another folder or delete it")

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(index)
        path = self.path(index)
        while not path.exists():
            if self._worker is None or not self._worker.is_alive():
                self.fill([index])
                break
            time.sleep(PATIENCE_S)
        return load(path, self.camera)

    def path(self, index: int) -> Path:
        """Where a frame is kept."""
        return self.folder / f"{index:06d}.npz"

    def fill(self, indices: Any) -> None:
        """Render those that are missing."""
        for index in indices:
            if not self.path(index).exists():
                save(self.path(index), self.source[index])

    def describe(self) -> dict[str, str]:
        """The source's facts."""
        return self.source.describe()

    def __enter__(self) -> Cached:
        if self._ahead and not all(self.path(i).exists() for i in range(len(self))):
            context = multiprocessing.get_context("fork")
            self._worker = context.Process(target=self.fill, args=(range(len(self)),), daemon=True)
            self._worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._worker is not None and self._worker.is_alive():
            self._worker.terminate()
            self._worker.join()

"""~/capture: raw messages of the newest keyframes as a bag that `calib-ros` reads, with configuration and result beside it."""

from __future__ import annotations

import importlib
import os
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime, timezone
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import yaml
from rclpy.serialization import serialize_message

from calib_ros.errors import BadInputError, MissingDependencyError
from calib_ros.messages import stamp_ns
from calib_ros.online.pipeline import Pipeline
from calib_ros.result import Result
from calib_ros.ros.conversions import Serialized
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.subscriptions import type_name


class RawKeyframe(NamedTuple):
    """The messages of one keyframe, as received."""

    image: Serialized
    cloud: Serialized
    camera_info: Serialized


class Capture:
    """Keeps the raw messages of at most capture_frames keyframes and writes them on request. Thread-safe.

    parameters: gives the current ones. camera_info: gives the newest CameraInfo message.
    """

    def __init__(self, parameters: Callable[[], Parameters], camera_info: Callable[[], Any]) -> None:
        self._parameters, self._camera_info = parameters, camera_info
        self._frames: deque[RawKeyframe] = deque(maxlen=parameters()["capture_frames"])
        self._lock = threading.Lock()
        if self._frames.maxlen:
            with suppress(MissingDependencyError):  # reported when somebody asks for a capture
                _types()  # now: imports block callbacks for tenths of a second

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, image: Any, cloud: Any) -> None:
        """Add the messages of a new keyframe. Keeps references: nothing is copied."""
        self.resize()
        with self._lock:
            self._frames.append(RawKeyframe(image, cloud, self._camera_info()))

    def resize(self) -> None:
        """Follow the parameter; fewer frames free their memory at once."""
        wanted = self._parameters()["capture_frames"]
        with self._lock:
            if self._frames.maxlen != wanted:
                self._frames = deque(self._frames, maxlen=wanted)

    def clear(self) -> None:
        """Drop the messages of all keyframes."""
        with self._lock:
            self._frames.clear()

    def write(self, pipeline: Pipeline) -> str:
        """A new folder in capture_dir with bag, config.yaml and result.json; returns what was written where, in a line.

        The folder is there when it is whole, or not at all. BadInputError if nothing is kept or it cannot be written.
        """
        parameters = self._parameters()
        if not parameters["capture_dir"] or not parameters["capture_frames"]:
            raise BadInputError(
                "nothing captured: set the parameters capture_dir to a folder and capture_frames to how many keyframes are to be "
                "kept in memory"
            )
        with self._lock:
            frames = list(self._frames)
        recalibrator = pipeline.recalibrator
        if not frames or recalibrator is None:
            raise BadInputError("nothing captured: no keyframe has come since capture_frames was set")
        result = recalibrator.current.result
        folder = Path(parameters["capture_dir"])
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with TemporaryDirectory(prefix=".capture.", dir=folder) as scratch:
                partial = Path(scratch) / "capture"
                partial.mkdir()
                _write_bag(partial / "bag", frames, result, parameters["image_is_rectified"])
                text = yaml.safe_dump({"/**": {"ros__parameters": parameters.to_dict()}}, sort_keys=False)
                (partial / "config.yaml").write_text(text, encoding="utf-8")
                result.save(partial / "result.json")
                target = _free_name(folder)
                os.rename(partial, target)
        except OSError as error:
            raise BadInputError(
                f"nothing captured: {folder} cannot be written ({error.strerror or error}); check the folder and its free space"
            ) from None
        return f"{len(frames)} keyframes saved to {target}"


def _free_name(folder: Path) -> Path:
    name = f"capture_{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}"
    names = chain([name], (f"{name}_{k}" for k in count(2)))
    return next(path for path in map(folder.joinpath, names) if not path.exists())


def _types() -> Any:
    """rosbags' message types, with all that writes a bag imported. MissingDependencyError without rosbags."""
    try:
        importlib.import_module("calib_ros.datasets.bag_writer")
        from calib_ros.datasets.bag_types import typestore
    except ImportError:
        raise MissingDependencyError("nothing captured: ~/capture needs rosbags; pip install rosbags") from None
    return typestore()


def _write_bag(path: Path, frames: list[RawKeyframe], result: Result, rectified: bool) -> None:
    types = _types()
    from rosbags.rosbag2 import StoragePlugin, Writer

    from calib_ros.datasets.bag_writer import BAG_VERSION, LATCHED, TF_STATIC, MessageBuilder

    # Whoever reads the bag knows by this name which numbers of CameraInfo count.
    topics = ("/image_rect" if rectified else "/image", "/camera_info", "/points")
    with Writer(path, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        latched = writer.add_connection(TF_STATIC, "tf2_msgs/msg/TFMessage", typestore=types, offered_qos_profiles=[LATCHED])
        kinds = [type_name(type(message.message())) for message in (frames[0].image, frames[0].camera_info, frames[0].cloud)]
        joined = [writer.add_connection(topic, kind, typestore=types) for topic, kind in zip(topics, kinds, strict=True)]
        entries = []
        for frame in frames:
            at_image, at_cloud = stamp_ns(frame.image.header.stamp), stamp_ns(frame.cloud.header.stamp)
            entries += [(at_image, 0, frame.camera_info), (at_image, 1, frame.image), (at_cloud, 2, frame.cloud)]
        entries.sort(key=lambda entry: entry[:2])
        # The messages' own names of the frames: the node's parameters may name them otherwise.
        build = MessageBuilder(
            types,
            frames[0].image.header.frame_id or result.camera_frame,
            frames[0].cloud.header.frame_id or result.lidar_frame,
        )
        tf = build.static_transform(entries[0][0], result.T_camera_lidar)
        writer.write(latched, entries[0][0], types.serialize_cdr(tf, "tf2_msgs/msg/TFMessage"))
        for stamp, role, message in entries:
            writer.write(joined[(1, 0, 2)[role]], stamp, serialize_message(message.message()))

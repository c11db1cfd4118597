"""Captures: raw messages of the newest keyframes as a bag, with what else the node knew, see `calib_ros.datasets.capture`.

One is written on request by ~/capture, and by the black box when the status becomes one of capture.on.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import threading
import time
from collections import deque
from contextlib import suppress
from datetime import datetime, timezone
from itertools import chain, count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import yaml
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.serialization import serialize_message
from std_srvs.srv import Trigger

from calib_ros.datasets.capture import BAG, CONFIG, EVENTS, MASK, RESULT
from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros.io import ABANDONED_S, flush
from calib_ros.messages import stamp_ns
from calib_ros.online.black_box import BlackBox, Occasion
from calib_ros.online.events import FrameIngested
from calib_ros.result import Result
from calib_ros.ros.conversions import Serialized
from calib_ros.ros.parameters import Parameters
from calib_ros.ros.parts import NodePart, done
from calib_ros.ros.subscriptions import type_name

BLACK_BOX = re.compile(r"event_\d{8}T\d{6}Z_[a-z]+(_\d+)?")  # the newest has the last name
SCRATCH = ".capture."  # hidden folders that are being written
# Bytes beside images and points: of a keyframe its CameraInfo and headers, of a bag the message types and an index.
KEYFRAME_BYTES, BAG_BYTES = 2_000, 30_000
KEPT, MOST_BYTES = 10, 1_000_000_000  # of the black box, together: a week of alarms, and less than any disk of a vehicle


class RawKeyframe(NamedTuple):
    """The messages of one keyframe, as received."""

    image: Serialized
    cloud: Serialized
    camera_info: Serialized


class Capture(NodePart):
    """Keeps the raw messages of at most capture_frames keyframes; writes them on ~/capture and for its black box. Thread-safe."""

    def __init__(self, own: Any) -> None:
        super().__init__(own)
        self._files = own.files
        self.black_box = BlackBox(own.pipeline, lambda: self._parameters["capture.on"], self._record)
        self._serve(Trigger, "~/capture", self._answer, MutuallyExclusiveCallbackGroup())
        self._frames: deque[RawKeyframe] = deque(maxlen=self._parameters["capture_frames"])
        self._lock = threading.Lock()
        if self._frames.maxlen:
            with suppress(MissingDependencyError):  # reported when somebody asks for a capture
                _types()  # now: imports block callbacks for tenths of a second

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, event: Any) -> None:
        """Keep the messages of a new keyframe. Keeps references: nothing is copied."""
        if isinstance(event, FrameIngested) and self.black_box.wants(event):
            self._resize()
            with self._lock:
                self._frames.append(RawKeyframe(event.image, event.cloud, self._own.sensors.camera_info))
        self.black_box.add(event)

    def check(self) -> None:
        """Follow the parameter; fewer frames free their memory at once."""
        self._resize()
        self.black_box.check()

    def pause(self) -> None:
        """Write what has happened by now."""
        self.black_box.check(flush=True)

    stop = pause

    def _record(self, occasion: Occasion, events: str) -> None:
        def write() -> None:
            try:
                said = self.write_occasion(occasion.kind, occasion.result, events)
                self._node.get_logger().info(f"{occasion.kind}: {said}")
            except CalibrationError as error:
                self._health.error(str(error), "capture.on")
            except Exception as error:
                self._health.unexpected(error)

        self._files.submit(write)

    async def _answer(self, request: Trigger.Request, response: Trigger.Response) -> None:
        written = await done(self._node, self._files.submit(self.write))
        response.message, response.success = written.result(), True

    def _resize(self) -> None:
        wanted = self._parameters["capture_frames"]
        with self._lock:
            if self._frames.maxlen != wanted:
                self._frames = deque(self._frames, maxlen=wanted)

    def clear(self) -> None:
        """Drop the messages of all keyframes."""
        with self._lock:
            self._frames.clear()

    def write(self) -> str:
        """A new capture in capture_dir, on request; returns what was written where, in a line.

        The folder is there when it is whole, or not at all. BadInputError if nothing is kept or it cannot be written.
        """
        parameters, recalibrator, frames = self._parameters, self._pipeline.recalibrator, self._kept()
        if not parameters["capture_dir"] or not parameters["capture_frames"]:
            raise BadInputError(
                "nothing captured: set the parameters capture_dir to a folder and capture_frames to how many keyframes are to be "
                "kept in memory"
            )
        if not frames or recalibrator is None:
            raise BadInputError("nothing captured: no keyframe has come since capture_frames was set")
        result = recalibrator.current.result
        return _write(parameters, "capture_{}", frames, result, _files(parameters, result, self.black_box.events()))

    def write_occasion(self, kind: str, result: Result, events: str) -> str:
        """The same for the black box. The oldest of its captures make room by KEPT and MOST_BYTES; keyframes that do
        not fit, the oldest ones, are left out."""
        parameters, frames = self._parameters, self._kept()
        files = _files(parameters, result, events)
        rest = MOST_BYTES - BAG_BYTES - sum(map(len, files.values()))
        while frames and sum(map(_size, frames)) > rest:
            del frames[0]
        if not frames:
            raise BadInputError(f"nothing captured of {kind}: there is no keyframe, or one takes all that captures may")
        size = MOST_BYTES - rest + sum(map(_size, frames))
        with suppress(OSError):  # said by who writes there
            inside = Path(parameters["capture_dir"]).iterdir()
            boxes = sorted(path for path in inside if BLACK_BOX.fullmatch(path.name) and path.is_dir() and not path.is_symlink())
            sizes = [sum(file.stat().st_size for file in box.rglob("*") if file.is_file()) for box in boxes]
            while boxes and (len(boxes) >= KEPT or sum(sizes) > MOST_BYTES - size):
                shutil.rmtree(boxes.pop(0), ignore_errors=True)
                del sizes[0]
        return _write(parameters, f"event_{{}}_{kind}", frames, result, files)

    def _kept(self) -> list[RawKeyframe]:
        with self._lock:
            return list(self._frames)


def _size(frame: RawKeyframe) -> int:
    """Bytes of a keyframe in a bag."""
    return len(frame.image.data) + len(frame.cloud.data) + KEYFRAME_BYTES


def _files(parameters: Parameters, result: Result, events: str) -> dict[str, bytes]:
    """What lies beside the bag: name -> content."""
    text = yaml.safe_dump({"/**": {"ros__parameters": parameters.to_dict()}}, sort_keys=False)
    files, mask = {CONFIG: text.encode(), RESULT: result.dumps().encode(), EVENTS: events.encode()}, parameters.config.image.mask
    with suppress(OSError):  # it is gone since: the frames are no worse for it
        files |= {MASK + Path(mask).suffix: Path(mask).read_bytes()} if mask else {}
    return files


def _write(parameters: Parameters, name: str, frames: list[RawKeyframe], result: Result, files: dict[str, bytes]) -> str:
    """name: of the new folder, {} = the time."""
    folder = Path(parameters["capture_dir"])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(f"{SCRATCH}*"):  # by a node that was killed
            with suppress(OSError):  # another node's, and just done
                if time.time() - left.stat().st_mtime > ABANDONED_S:
                    shutil.rmtree(left)
        with TemporaryDirectory(prefix=SCRATCH, dir=folder) as scratch:
            partial = Path(scratch) / "capture"
            partial.mkdir()
            _write_bag(partial / BAG, frames, result, parameters["image_is_rectified"])
            for file, data in files.items():
                (partial / file).write_bytes(data)
            for path in (*partial.rglob("*"), partial):
                flush(path)
            wanted = name.format(f"{datetime.now(timezone.utc):%Y%m%dT%H%M%SZ}")
            candidates = map(folder.joinpath, chain([wanted], (f"{wanted}_{k}" for k in count(2))))
            target = next(path for path in candidates if not path.exists())
            os.rename(partial, target)
        flush(folder)
    except OSError as error:
        raise BadInputError(
            f"nothing captured: {folder} cannot be written ({error.strerror or error}); check the folder and its free space"
        ) from None
    return f"{len(frames)} keyframes saved to {target}"


def _types() -> Any:
    """rosbags' message types, with all that writes a bag imported. MissingDependencyError without rosbags."""
    try:
        importlib.import_module("calib_ros.datasets.bag_writer")
        from calib_ros.datasets.bag_messages import typestore
    except ImportError:
        raise MissingDependencyError("nothing captured: ~/capture needs rosbags; pip install rosbags") from None
    return typestore()


def _write_bag(path: Path, frames: list[RawKeyframe], result: Result, rectified: bool) -> None:
    types = _types()
    from rosbags.rosbag2 import StoragePlugin, Writer

    from calib_ros.datasets.bag_file import TF_STATIC
    from calib_ros.datasets.bag_writer import BAG_VERSION, LATCHED, transforms_message

    # Whoever reads the bag knows by this name which numbers of CameraInfo count.
    topics = ("/image_rect" if rectified else "/image", "/camera_info", "/points")
    with Writer(path, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        latched = writer.add_connection(TF_STATIC, "tf2_msgs/msg/TFMessage", typestore=types, offered_qos_profiles=[LATCHED])
        kinds = [type_name(type(message.message())) for message in (frames[0].image, frames[0].camera_info, frames[0].cloud)]
        joined = [writer.add_connection(topic, kind, typestore=types) for topic, kind in zip(topics, kinds, strict=True)]
        entries = []
        for frame in frames:
            at = stamp_ns(frame.image.header.stamp)  # of all, since clocks of clouds may differ by years: this tells the reader
            entries += [(at, 0, frame.camera_info), (at, 1, frame.image), (at, 2, frame.cloud)]
        entries.sort(key=lambda entry: entry[:2])
        # The messages' own names of the frames: the node's parameters may name them otherwise.
        camera, lidar = frames[0].image.header.frame_id, frames[0].cloud.header.frame_id
        children = {lidar or result.lidar_frame: result.T_camera_lidar}
        tf = transforms_message(entries[0][0], camera or result.camera_frame, children)
        writer.write(latched, entries[0][0], types.serialize_cdr(tf, "tf2_msgs/msg/TFMessage"))
        for stamp, role, message in entries:
            writer.write(joined[(1, 0, 2)[role]], stamp, serialize_message(message.message()))
